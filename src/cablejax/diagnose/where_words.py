"""Describes the place of the gap in a few plain sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cablejax.diagnose.judgement import listed
from cablejax.diagnose.significance import LEVEL

if TYPE_CHECKING:
    from cablejax.diagnose.where import Where

# How many times larger a gap has to be for a sentence about it.
_CLEAR_RATIO = 1.5
# Share of the squared gap that one frame has to explain, or that has to lie along the cable.
_FRAME_SHARE = 0.7


def describe(
    where: Where,
    arclength: np.ndarray,
    noise: np.ndarray,
    names: Sequence[str] | None = None,
    motions: int | None = None,
) -> tuple[str, ...]:
    """Two to five sentences for a lab engineer.

    Args:
        where: the numbers; its own sentences are not read. Where nothing was tested, the sentences give sizes only.
        arclength: of the keypoints [m].
        noise: standard deviation of each keypoint's coordinates [m].
        names: what to call each episode; by default "episode 0" and so on.
        motions: how many of the episodes that were seen repeat no other; by default all.
    """
    floor, seen = 1e3 * float(np.sqrt((noise**2).mean())), _seen(where)
    total = len(seen)
    names = names or [f"episode {e}" for e in range(len(where.per_episode_mm))]
    if where.episode_p is None or where.keypoint_p is None:
        return (_size(where, None, floor, names), *_along(where, arclength), *_when(where), *_frame(where))[:5]
    shown = [e for e in seen if where.episode_p[e] < LEVEL]
    if not shown and not (where.keypoint_p < LEVEL).any():
        return (
            f"No episode deviates from the simulator by more than the noise of {_mm(floor)}.",
            f"A gap of {_mm(max(where.smallest_mm, 0.01))} or more over the whole log would have shown.",
        )
    sentences = [_size(where, shown, floor, names), *_direction(where), *_along(where, arclength), *_when(where)]
    sentences += _frame(where)
    motions = total if motions is None else motions
    if motions >= 6:
        return tuple(sentences[:5])
    recorded = f"{motions} {'episode' if motions == total else 'different motion'}{'' if motions == 1 else 's'}"
    few = f"With {recorded} no comparison between regimes can be tested at the 5 % level: six are needed."
    return (*sentences[:4], few)


def _size(where: Where, shown: list[int] | None, floor: float, names: Sequence[str]) -> str:
    """Size of the gap, and its episodes; `shown` are those in which tests found it, None without tests."""
    sizes, seen = where.per_episode_mm, _seen(where)
    total = len(seen)
    size = f"The gap is {_mm(where.gap_mm)} above the noise of {_mm(floor)}"
    if shown is not None and not shown:
        return f"{size}, too small to show in any single episode."
    if shown is not None and len(shown) < total:
        return f"{size}; it shows in only {len(shown)} of {total} episodes: {listed([names[e] for e in shown])}."
    if total == 1:
        return f"{size}, in the one episode."
    worst = max(seen, key=lambda e: sizes[e])
    others = float(np.median([sizes[e] for e in seen if e != worst]))
    if shown is None:
        return (
            f"{size}. It is largest in {names[worst]}, {_mm(sizes[worst])}; the median of the others is {_mm(others)}."
        )
    if sizes[worst] > 2.5 * others:
        return f"{size}, in every episode but mostly in {names[worst]}: {_mm(sizes[worst])}."
    return f"{size}, in every episode."


def _seen(where: Where) -> list[int]:
    """Episodes of which something was observed."""
    return np.flatnonzero(np.isfinite(where.heat).any(axis=(1, 2))).tolist()


def _along(where: Where, arclength: np.ndarray) -> list[str]:
    ends, seen = where.along_cable_mm[[0, -1]], np.isfinite(where.along_cable_mm)
    profile, marks = where.along_cable_mm[seen], arclength[seen]
    if len(profile) < 4 or profile.max() <= 0:
        return []
    peak = int(np.argmax(profile))
    if ends.min() > 0.5 * profile.max():
        return [
            f"It reaches the grippers, {_mm(ends.min())} at the smaller end against {_mm(profile.max())} at most: "
            "the camera's frame, the arms or the grasps are off, not only the cable between them."
        ]
    near = np.flatnonzero(profile >= 0.5 * profile.max())
    low, high = marks[near[0]], marks[near[-1]]
    outside = np.delete(profile, np.arange(near[0], near[-1] + 1))
    rest = f" against {_mm(np.sqrt((outside**2).mean()))} elsewhere" if len(outside) else ""
    place = f"between {low:.2f} and {high:.2f} m" if high > low else f"at {low:.2f} m"
    sentence = f"Along the cable it is largest {place}, {_mm(profile[peak])} at {marks[peak]:.2f} m{rest}."
    bend = where.bend_per_m
    if bend is not None and bend.max() > 0:
        strong = np.flatnonzero(bend >= 0.7 * bend.max())
        at = arclength[1:-1][strong]
        together = strong[-1] - strong[0] == len(strong) - 1
        if together and at[-1] - at[0] < 0.4 * (arclength[-1] - arclength[0]):
            place = f"between {at[0]:.2f} and {at[-1]:.2f} m" if at[-1] > at[0] else f"around {at[0]:.2f} m"
            sentence = sentence[:-1] + f"; the cable's bending differs most {place}."
    return [sentence]


def _when(where: Where) -> list[str]:
    sentences = []
    known = {name: (ratio, p) for name, (ratio, p) in where.contrasts.items() if p < LEVEL}
    hold, slow, fast = (where.regimes.get(f"speed: {one}") for one in ("hold", "slow", "fast"))
    sizes = [size for size in (slow, fast) if size is not None]
    moving = float(np.sqrt(np.mean(np.square(sizes)))) if sizes else None
    if hold is not None and moving is not None:
        if "speed: hold" in known and known["speed: hold"][0] < 1 / _CLEAR_RATIO:
            sentences.append(
                f"It grows with motion, {_mm(moving)} against {_mm(hold)} in holds: suspect a lag or drag."
            )
        elif hold > 0.7 * moving and hold > 0:
            sentences.append(f"It remains while the grippers rest, {_mm(hold)} in holds: not a lag.")
    if where.episode_p is None and slow is not None and fast is not None:
        sentences.append(f"It is {_mm(fast)} while the grippers move fast, {_mm(slow)} while they move slowly.")
    horizons = list(where.horizons_mm.items())
    if len(horizons) > 2:
        first, early = horizons[0]
        last, late = max(horizons, key=lambda item: item[1])
        if early > 0.7 * late:
            sentences.append(f"It is there from the start, {_mm(early)} within the first {first:g} s.")
        elif late > 3 * max(early, 0.05):
            sentences.append(f"It builds up: {_mm(early)} in the first {first:g} s, {_mm(late)} by {last:g} s.")
    words = {
        "speed: fast": ("when the grippers move fast", "when the grippers move slowly"),
        "curvature: high": ("where the cable is strongly bent", "where the cable is nearly straight"),
        "gripper distance: short": ("when the grippers are close", "when the grippers are far apart"),
        "direction: grippers closing": ("while the grippers close", "while the grippers open"),
        "reversal: after": ("after a reversal", "before the first reversal"),
    }
    for name, (ratio, _) in sorted(known.items(), key=lambda item: -abs(np.log(item[1][0]))):
        if name in words and abs(np.log(ratio)) > np.log(_CLEAR_RATIO):
            more = words[name][0 if ratio > 1 else 1]
            sentences.append(f"It is {max(ratio, 1 / ratio):.1f} times larger {more}.")
            break
    return sentences


def _direction(where: Where) -> list[str]:
    share = where.along_share or 0.0
    if share <= _FRAME_SHARE:
        return []
    return [
        f"{100 * share:.0f} % of it lies along the cable, but what bends a cable moves it mostly "
        "across: look for keypoints that the tracker lets slide along it, wrong arc lengths, a stretch or a slip."
    ]


def _frame(where: Where) -> list[str]:
    frames = where.frames
    if frames.get("image", 0.0) > _FRAME_SHARE:
        return [f"Shifting, rotating and scaling the camera's frame would remove {100 * frames['image']:.0f} % of it."]
    best = max(("body", "table"), key=lambda name: frames.get(name, 0.0))
    if frames.get(best, 0.0) > _FRAME_SHARE:
        words = {
            "body": "each keypoint is displaced by the same amount along and across the cable",
            "table": "each keypoint is displaced by the same amount in x and y",
        }
        return [f"{100 * frames[best]:.0f} % of it does not change with the motion: {words[best]}."]
    return []


def _mm(value: float) -> str:
    return f"{value:.2f} mm" if 0.0 < value < 0.095 else f"{value:.1f} mm"
