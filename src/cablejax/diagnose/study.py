"""Rules of a study in rounds: the first recording, and whether another recording is worth its time."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cablejax.cable import Cable, Discretisation
from cablejax.diagnose.diagnosis import Diagnosis
from cablejax.diagnose.judgement import in_its_place
from cablejax.diagnose.motion_bounds import SNAP_THROUGH, Bounds, cable_beyond, grippers_beyond
from cablejax.diagnose.motion_design import excluded_by
from cablejax.diagnose.motion_file import commands_log
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.safe_motions import INTERVAL, there_and_back
from cablejax.types import GapLog

Ended = Literal["clear", "unknown", "inseparable", "rounds"]
"""There is a clear answer; no effect explains all of the gap; no motion separates what is left; no rounds are left."""

ENDED: dict[Ended, str] = {
    "clear": "The answer is clear.",
    "unknown": "No effect of the library explains the whole gap.",
    "inseparable": "No motion that was tried separates the remaining causes: measure one of them by other means.",
    "rounds": "All rounds are used up: allow more with --rounds and another --out, which makes these again.",
}
"""Why a study ended, in words."""


def first_recording(
    cable: Cable,
    start: Float[np.ndarray, "2 3"],
    goals: Mapping[str, Float[np.ndarray, "2 3"]],
    bounds: Bounds = Bounds(),
) -> GapLog:
    """The commands of a study's first recording: to each goal and back, as a robot moves that shapes the cable.

    Args:
        cable: that is believed to be moved.
        start: gripper poses (x, y, theta) of every motion [m, rad]; in a workspace start and goals are moved to the
            middle of it. A start farther apart than the bounds allow is brought together.
        goals: gripper poses by name. A motion that breaks the bounds, on the grippers or on the cable as it is believed
            to be, is left out; one that comes close to a snap-through is not, since a robot that shapes a cable does
            that too.
        bounds: to keep.

    Raises:
        ValueError: none keeps the bounds; says how many each bound excludes.
    """
    config, (_, farthest) = Discretisation(cable), bounds.distances(cable.length)
    centre, apart = start[:, :2].mean(axis=0), float(np.linalg.norm(start[1, :2] - start[0, :2]))
    start = start.copy()
    start[:, :2] = centre + min(1.0, farthest / max(apart, 1e-9)) * (start[:, :2] - centre)
    middle = np.zeros(3) if bounds.workspace is None else np.append(np.mean(bounds.workspace, axis=0), 0.0)
    motions = {name: there_and_back(start + middle, goal + middle, bounds=bounds) for name, goal in goals.items()}
    broken = {
        name: {*grippers_beyond(bounds, config, poses, INTERVAL)} - {SNAP_THROUGH} for name, poses in motions.items()
    }
    seen = _simulated(config, {name: poses for name, poses in motions.items() if not broken[name]})
    broken |= {
        name: {*cable_beyond(bounds, config, motions[name], points[None])} - {SNAP_THROUGH}
        for name, points in seen.items()
    }
    kept = {name: poses for name, poses in motions.items() if not broken[name]}
    if not kept:
        words = excluded_by(broken.values())
        raise ValueError(
            f"None of the first motions of a study ({', '.join(goals)}) keeps the bounds: {words}. Record a first "
            "motion of your own, and give it to `cablejax diagnose` with these bounds."
        )
    return commands_log(kept, INTERVAL, cable)


def _simulated(
    config: Discretisation, motions: Mapping[str, Float[np.ndarray, "T 2 3"]]
) -> dict[str, Float[np.ndarray, "T N 2"]]:
    """Keypoints of the cable as it is believed to be on each motion [m]."""
    if not motions:
        return {}
    longest = max(map(len, motions.values()))
    padded = np.stack([np.pad(p, ((0, longest - len(p)), (0, 0), (0, 0)), "edge") for p in motions.values()])
    playback = Playback.of_motion(config, padded, None, np.full(len(padded), INTERVAL))
    points = dataclasses.replace(playback, rows=len(padded)).keypoints([playback.believed])[0]
    return {name: seen[: len(poses)] for (name, poses), seen in zip(motions.items(), points, strict=True)}


def ended(found: Diagnosis, worth: Mapping[str, Any] | None, *, rounds_left: int) -> Ended | None:
    """The reason why no further recording follows a diagnosis; None if one does.

    Args:
        found: of all recordings so far.
        worth: of the next motion, as `verdict_json` writes it; None where there is none.
        rounds_left: how many recordings may still be made.
    """
    several = found.verdict == "ambiguous" and any(len(names) > 1 for names in alternatives(found))
    if not several and not found.undecided:
        return "unknown" if found.verdict in ("unknown", "named+unknown") else "clear"
    if worth is None or worth["inseparable"]:
        return "inseparable"
    return None if rounds_left > 0 else "rounds"


def left_open(found: Diagnosis) -> tuple[str, ...]:
    """All of `alternatives`."""
    return tuple(dict.fromkeys(name for names in alternatives(found) for name in names))


def alternatives(found: Diagnosis) -> tuple[tuple[str, ...], ...]:
    """For each named effect, the alternatives of `in_its_place`; once if both grippers have it."""
    names = dict.fromkeys(effect.name for effect in found.effects)
    return tuple(tuple(in_its_place(name, found.equivalent, found.effects)) for name in names)
