"""What a reader has to know of a verdict on a cable in space."""

from __future__ import annotations

import numpy as np

from cablejax.diagnose.diagnosis import Gap
from cablejax.diagnose.judgement import listed
from cablejax.spatial.cable import GOOD_FIT
from cablejax.spatial.effects import GRIP
from cablejax.spatial.gap import OWN
from cablejax.spatial.identify import Identified
from cablejax.spatial.windows import Windows

STIFF = 3.0
"""A cable that is not so many times longer than the length over which it bends is held up by its grippers."""


def hidden_sentence(hidden: Gap) -> str:
    """The verdict on a cable whose nominal simulation amplifies noise too much to be judged, see `Judgement.hidden`."""
    return (
        "This recording does not show whether the simulator is wrong: the nominal cable amplifies noise until two "
        "simulations of it are as far apart as one is from the recording. All effects of the library together lessen "
        f"the error from {hidden.before_rmse_mm:.1f} to {hidden.after_rmse_mm:.1f} mm, which noise alone would not: "
        "record calmer motions."
    )


def caveats(
    windows: Windows, left_out: int, found: Identified, compared_s: float | None, own: float, own_after: float
) -> tuple[str, ...]:
    """What a reader has to know of the verdict, one sentence or a few each.

    Args:
        windows: that were diagnosed.
        left_out: number of those labelled eval.
        found: in the windows.
        compared_s: beginning of each window in which the gap is measured [s]; None = whole windows.
        own: error of the nominal cable by itself, see `gap.own_error` [m].
        own_after: the same of the explained cable [m].
    """
    result = [
        "The motion of a hanging cable does not depend on its weight. Stiffness, drag and added masses are estimated "
        "relative to the linear density of the cable with its markers, and a wrong density (linear_density) is not "
        "identifiable.",
        "A lag between keypoints and separately measured gripper poses is not an effect in space; it is estimated from "
        "the keypoints at the grippers."
        if windows.rolls
        else (
            "Keypoints and gripper poses come from the same markers, so a camera lag would shift both alike: "
            "camera_lag is not identifiable."
        ),
        "The noise is the scatter of markers from one sample to the next. A marker that sits off the centreline or "
        "off its stated arc length has a constant error. That error belongs to the constant offsets, not to the "
        "noise, and so does the simulator's error at rest.",
        "The grippers' roll about the cable is taken from the log's quaternions."
        if windows.rolls
        else (
            "The grippers' roll about the cable is not observed, or the roll in the log does not bring the nominal "
            "simulation closer to the recording. It is assumed to be the smallest rotation from their mean direction."
        ),
        "All effects that were tried are fitted together. The gap after is the error with the named effects, of an "
        "unknown cause that with all of them, at their values from that fit, on recordings that no fit has seen.",
    ]
    if "gripper_rotation_offset" in found.tried:
        fitted = found.everything.explanation.own
        # of a recording whose windows are all too short for a fit there is none
        grips = GRIP * np.array([fitted[group] for group in np.unique(windows.group) if group < len(fitted)])
        size = f"{np.sqrt((grips**2).mean()):.2f} rad (root mean square) from the mean."
        unseen = " Recordings that no fit has seen are predicted with the mean." if windows.group.max() > 0 else ""
        result.append(
            f"The angle of the cable in the grippers is fitted for each recording: it differs by {size}{unseen}"
        )
    if compared_s is not None:
        result.append(
            "The nominal cable amplifies the noise in the first two samples of each window until it moves as far from "
            f"itself as from the recording. The gap is therefore that of the first {compared_s:g} s of each window."
        )
    if own > OWN:
        result.append(
            "Noise in the first two samples of each window and the edges of the simulated cable alone cause errors of "
            f"the nominal cable of {1e3 * own:.1f} mm. Errors of up to 1.5 times this size do not count as a gap."
        )
    if own_after > GOOD_FIT:
        result.append(
            "Noise in the first two samples of each window alone causes errors of the explained cable of "
            f"{1e3 * own_after:.1f} mm, which are part of the gap after. The values fitted to such motion may be off "
            "by more than their intervals: record slower ones."
        )
    if windows.smoothed:
        result.append(
            f"The grippers' measured paths scatter by {1e3 * windows.smoothed:.2g} mm from one sample to the next. "
            "They were smoothed. The remaining scatter shakes the simulated cable, so a bending damping may be "
            "overestimated."
        )
    if left_out:
        result.append(f"{left_out} windows are labelled eval; they were used neither for fits nor for scores.")
    return (*result, *_on_fits(windows, found))


def _on_fits(windows: Windows, found: Identified) -> list[str]:
    """What the fits, the simulated cable and the recordings leave open."""
    result = []
    if not found.time_steps.fine_enough:
        result.append(
            "The grippers move too fast for the finest time steps of the simulation: halving these would change the "
            f"motion by {1e3 * found.time_steps.error:.1f} mm. Gaps of that size may be the simulation's own error."
        )
    parts = ("one half of the recordings", "the other half", "all recordings")
    if moving := [part for part, one in zip(parts, (*found.halves, found.everything), strict=True) if not one.settled]:
        result.append(
            f"The parameters of the fit to {listed(moving)} still changed in the last correction for the length of the "
            "simulator's edges and time steps: they may be off by more than their intervals."
        )
    groups = len(np.unique(windows.group))
    if groups == 1:
        result.append(
            "There is only one recording: intervals are over its windows, without what differs between recordings."
        )
    elif groups < 6:
        result.append(f"There are only {groups} recordings: intervals over recordings are rough.")
    bends, length, why, absent = found.bends_over, windows.arclength[-1], "", ""
    if not found.resolved:
        absent = (
            ", and an effect that is named may not be there. Effects that do not help to simulate other recordings are "
            "not named, whatever their values"
        )
        why = "less than an edge of the simulated cable, so its bending hardly shows"
    elif bends > length / STIFF:
        why = (
            "more than a third of its length, so its weight says little of the stiffness, and twist and markers off "
            "the centreline, which are not simulated, weigh more"
        )
    if why:
        result.append(
            f"By its estimated stiffness the cable bends over about {1e2 * bends:.2g} cm under its own weight. That is "
            f"{why}. Values of the stiffness, its profile and its damping may be off by more than their intervals"
            f"{absent}."
        )
    return result
