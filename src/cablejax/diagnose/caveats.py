"""Caveats of a planar diagnosis: limits of the verdict, in sentences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cablejax.diagnose.actuation_verdict import negligible
from cablejax.diagnose.belief import Calibration, excused
from cablejax.diagnose.case import STATED, Case, calibrated
from cablejax.diagnose.conclude import Conclusion
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.length import Length
from cablejax.diagnose.motion_judge import MARGIN
from cablejax.diagnose.noise import SMALLEST
from cablejax.diagnose.rounds import UNLIKELY, Rounds

# Reported: holds in which keypoints scatter by this many times what they do between samples.
_SCATTERED = 1.5
# Reported: a named cause that leaves as much of the gap as only this share of correct ones.
_RARE = 0.1


def contradictions(rounds: Rounds | None) -> tuple[str, ...]:
    """That recordings of one set-up need different parameters, if they do."""
    if rounds is None or not rounds.contradictory:
        return ()
    return (
        f"The recordings contradict one another: the best explanation of {rounds.odd_one.name} has other parameters "
        f"than that of the rest. Recordings of one set-up differ this much in fewer than {UNLIKELY:g} of all cases. "
        "Check what was changed between them, and diagnose each one alone.",
    )


def silent_motions(evidence: Evidence, conclusion: Conclusion, calibration: Calibration) -> Iterator[str]:
    """What the verdict "none" leaves out, if anything."""
    if conclusion.verdict != "none":
        return
    for episode, gap, own in excused(conclusion.best, evidence, calibration):
        yield (
            f"Episode {episode} is no evidence for or against a gap: the nominal simulator misses the cable by "
            f"{1e3 * gap:.2g} mm per coordinate, and may be off by {1e3 * own:.2g} mm there without any effect. Small "
            "errors grow in this motion, for example where the cable snaps over or a wrong pose strains it. Check the "
            "episode, or record a calmer motion."
        )


def rarely_left(conclusion: Conclusion) -> Iterator[str]:
    """That correct causes seldom leave as much of the gap as the one that is named, if they do."""
    rare = conclusion.leftover_p
    if conclusion.verdict in ("named", "ambiguous") and rare is not None and rare <= _RARE:
        yield (
            f"Of the correct explanations on labelled logs, {100 * rare:.0f} % leave as large a part of the gap as "
            "this one. The cause may be outside the library and only resemble what is named, or one more effect may be "
            "there: look for it on the set-up, and record more motions before you act on the name."
        )


def caveats_of(
    case: Case, calibration: Calibration, length: Length | None, stated: float, *, commissioned: bool
) -> tuple[str, ...]:
    """What limits a diagnosis by its recording.

    Args:
        case: that was diagnosed.
        calibration: of the judgement.
        length: that the keypoints suggest besides the stated one.
        stated: see `Case.stated_error`.
        commissioned: whether logs without an effect were given.
    """
    caveats = list(case.recording.caveats)
    seen = np.isfinite(case.recording.keypoints).any(axis=(1, 2, 3))
    if len(np.unique(case.motion[seen])) < 2:
        one = "episode" if len(case.motion) == 1 else "motion in which keypoints were observed"
        caveats.append(
            f"The log has one {one}, so none can be held out: no shrinkage is reported, and every probability is less "
            "certain than it looks."
        )
    if not commissioned:
        caveats.append(
            "No commissioning logs were given: the simulator's own error cannot be separated from the gap and is "
            f"assumed to be {1e3 * calibration.baseline:.2g} mm."
        )
    if stated > calibrated(case.config.cable.length).baseline:
        caveats.append(
            f"This cable is sensitive to its stated properties: {100 * STATED:g} % more or less stiffness or friction "
            f"moves keypoints by {1e3 * stated:.2g} mm per coordinate, so only a larger gap counts."
        )
    if case.scatter.any():
        caveats.append(
            f"The measured gripper poses scatter by up to {1e3 * case.scatter[:, :2].max():.2g} mm and "
            f"{1e3 * case.scatter[:, 2].max():.2g} mrad from one sample to the next. They were smoothed, since this "
            "scatter would shake the simulated cable."
        )
    if case.arms.strays(negligible(calibration, case.config.cable.length)):
        caveats.append(
            f"The measured poses deviate from the commanded ones by {1e3 * case.arms.deviation:.3g} mm (root mean "
            "square), and neither a gain nor a lag explains that. Check the frame and the units of gripper_command, "
            "whether the commands of both arms were logged, and whether every motion was executed to its end."
        )
    if case.recording.has_commands:
        off = np.linalg.norm((case.recording.gripper_pose - case.arms.commanded)[..., :2], axis=-1).max(axis=(1, 2))
        if off.max() > MARGIN:
            caveats.append(
                f"Motions were not executed as commanded: the grippers of episode {int(off.argmax())} are up to "
                f"{1e3 * off.max():.3g} mm from their commands, more than the {1e3 * MARGIN:g} mm by which a designed "
                "motion keeps its bounds. The diagnosis uses the measured poses. If this was not intended, record the "
                "motions again, or leave out their commands."
            )
    scatter, rapid = float(np.median(case.noise.std)), case.noise.rapid
    if case.noise.from_holds and rapid > 0 and scatter > _SCATTERED * rapid:
        caveats.append(
            f"Keypoints scatter by {1e3 * scatter:.2g} mm while the grippers rest, and by {1e3 * rapid:.2g} mm from "
            "one sample to the next: their noise is correlated, or the cable still moves in samples marked as holds. "
            "The larger value is taken as the noise, and gaps below it are not detected."
        )
    if case.noise.restless:
        caveats.append(
            f"In {case.noise.restless} of the holds the keypoints scatter far more than in the others: the cable moves "
            "there, so these holds are not used to estimate the noise. Mark only samples in which the cable is at rest "
            "too."
        )
    if length is not None:
        caveats.append(
            f"Keypoints are {length.apart}. A wrong length_m or keypoint_arclength_m causes this, and so do a camera's "
            "scale and a cable that stretches: check the length before you trust a verdict of scale or stretch."
        )
    if case.noise.std.max() <= SMALLEST:
        caveats.append(f"The keypoints have almost no noise; {1e3 * SMALLEST:g} mm is assumed.")
    return tuple(caveats)
