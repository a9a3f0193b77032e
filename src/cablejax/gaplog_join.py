"""Joins recordings of one set-up into one gap log that records its parts, and selects episodes of a log."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cablejax.gaplog import TARGETS, Episode, episodes_of, stack_episodes, targets_of
from cablejax.gaplog_check import META_FIELDS, GapLogError
from cablejax.limits import LIMITS, shown
from cablejax.types import GapLog

MEASURED = 0.005
"""Part of a cable's length by which arc lengths measured along its keypoints differ from one recording to another: by
noise, and by how it was bent."""
EPISODE_LABELS = ("file", "recording", "split", "take")
"""Extra fields of `meta` with one entry per episode that importers write; what a diagnosis keeps apart by them."""
COMMANDS_DERIVED = "commands_from_poses"
"""Field of `meta`: whether an importer made commands of the poses and none are known; of all, or of each episode."""
_FIRST = 8
SAME = 1e-6
"""Difference of two numbers, relative and absolute, below which recordings state or saw the same [m, s]."""


def joined(logs: Sequence[GapLog], names: Sequence[str]) -> GapLog:
    """One log of several recordings of one set-up, episodes in the order given.

    Its `meta` has the field `recordings`: the name of each and how many episodes it has, by which a diagnosis says what
    each one added. Of the extra fields of `meta`, targets and `EPISODE_LABELS` are joined (equal names of different
    logs stay apart), `COMMANDS_DERIVED` is said of each episode where they differ, what any has guessed is guessed, and
    others stay where all recordings have the same. Arc lengths that an importer measured in each may differ by
    `MEASURED`; the log has their mean over the episodes.

    Args:
        logs: at least one.
        names: of each, for example that of its file; one that was joined itself keeps its parts' names.

    Raises:
        GapLogError: recordings of different set-ups, or an episode twice; names both and what differs. Or one without
            any keypoint.
    """
    if not logs:
        raise GapLogError("Nothing to join: expected at least one gap log.")
    if len(names) != len(logs):
        raise GapLogError(f"There are {len(names)} names, expected one for each of the {len(logs)} gap logs.")
    logs = _of_one_length(logs)
    _require_each_once(logs, names)
    _require_one_set_up(logs, names)
    derived = np.concatenate([commands_derived(log) for log in logs])
    # what one of them guessed of the cable that they share is a guess
    guessed = list(dict.fromkeys(name for log in logs for name in _guessed(log)))
    own_words = {*META_FIELDS, *EPISODE_LABELS, COMMANDS_DERIVED, TARGETS, "guessed", "recordings"}
    targets = [None if target is None else target.tolist() for log in logs for target in targets_of(log)]
    extra = set.intersection(*(set(log.meta) for log in logs)) - own_words
    shared = [name for name in sorted(extra) if all(log.meta[name] == logs[0].meta[name] for log in logs)]
    meta = {
        **{name: logs[0].meta[name] for name in (*META_FIELDS, *shared)},
        **{name: values for name in EPISODE_LABELS if (values := _labels(logs, names, name)) is not None},
        **({COMMANDS_DERIVED: True if derived.all() else derived.tolist()} if derived.any() else {}),
        **({"guessed": guessed} if guessed else {}),
        **({TARGETS: targets} if any(target is not None for target in targets) else {}),
        "motion": [motion for log in logs for motion in log.meta["motion"]],
        "source": "; ".join(dict.fromkeys(log.meta["source"] for log in logs)),
        "recordings": [part for log, name in zip(logs, names, strict=True) for part in recordings(log, name)],
    }
    episodes = [episode for log in logs for episode in episodes_of(log)]
    return stack_episodes(episodes, meta, holds=any(log.hold is not None for log in logs))


def _require_each_once(logs: Sequence[GapLog], names: Sequence[str]) -> None:
    """Raises GapLogError if two logs share an episode, which would count twice, or one of them shows no keypoint."""
    seen: list[tuple[Episode, str]] = []
    begun = np.zeros((0, _FIRST))
    for log, name in zip(logs, names, strict=True):
        own = [one for one in episodes_of(log) if np.isfinite(one.keypoints).any()]
        if not own:
            raise GapLogError(
                f"No keypoint is observed in {name}: it shows no cable. If these are the commands of a motion, execute "
                "them, and give the recording."
            )
        first = np.array([_numbers(one)[:_FIRST] for one in own]).reshape(-1, _FIRST)
        for one, numbers in zip(own, first, strict=True):
            # the first few numbers decide nearly always
            alike = np.isclose(begun, numbers, SAME, SAME, equal_nan=True).all(axis=1)
            for other, other_name in (seen[i] for i in np.flatnonzero(alike)):
                if _same_samples(one, other):
                    raise GapLogError(
                        f"{other_name} and {name} share an episode with identical samples: give each recording once, "
                        "or it would count twice."
                    )
        seen += [(one, name) for one in own]
        begun = np.concatenate([begun, first])


def _require_one_set_up(logs: Sequence[GapLog], names: Sequence[str]) -> None:
    """Raises GapLogError if logs differ in what recordings of one set-up have in common."""
    stated = _set_up(logs[0])
    for log, name in zip(logs, names, strict=True):
        own = _set_up(log)
        for field in stated | own:
            here, there = own.get(field), stated.get(field)
            if not _same(here, there):
                raise GapLogError(
                    f"{name} is not of the set-up of {names[0]}: '{field}' is {shown(here)} instead of {shown(there)}. "
                    "Diagnose them separately, or correct the log that states it wrongly."
                )


def commands_derived(log: GapLog) -> Bool[np.ndarray, "E"]:
    """Episodes whose commands an importer derived from poses, see `COMMANDS_DERIVED`.

    Raises:
        GapLogError: the field is neither one word nor one for each episode.
    """
    value, episodes = log.meta.get(COMMANDS_DERIVED, False), len(log.episode_length)
    every = value if isinstance(value, list) else [value] * episodes
    if len(every) != episodes or not all(isinstance(one, bool) for one in every):
        raise GapLogError(
            f"Field 'meta.{COMMANDS_DERIVED}' is {shown(value)}, expected true or false, or a list of {episodes}."
        )
    return np.array(every)


def _same_samples(one: Episode, other: Episode) -> bool:
    """Whether the same was observed, and when after the beginning: in whatever unit and time base it was stored."""
    if one.keypoints.shape != other.keypoints.shape:
        return False
    return np.allclose(_numbers(one), _numbers(other), SAME, SAME, equal_nan=True)


def _numbers(episode: Episode) -> Float[np.ndarray, " M"]:
    """What was observed, and when after the beginning; at least `_FIRST` numbers."""
    numbers = np.append(episode.keypoints.astype(float).ravel(), episode.time - episode.time[0])
    return np.append(numbers, np.zeros(max(_FIRST - len(numbers), 0)))


def _same(here: Any, there: Any) -> bool:
    """Whether two set-ups state the same, numbers within rounding."""
    if isinstance(here, dict) and isinstance(there, dict):
        return here.keys() == there.keys() and all(_same(here[key], there[key]) for key in here)
    if isinstance(here, list) and isinstance(there, list):
        return len(here) == len(there) and all(map(_same, here, there))
    if isinstance(here, (int, float)) and isinstance(there, (int, float)):
        return math.isclose(here, there, rel_tol=SAME, abs_tol=SAME**2)
    return here == there


def _of_one_length(logs: Sequence[GapLog]) -> Sequence[GapLog]:
    """The logs with the mean of the arc lengths that were measured in each, if they differ as measurements do."""
    marks = [np.asarray(log.meta["keypoint_arclength_m"], float) for log in logs]
    measured = all(log.meta.get("arclength_measured") is True for log in logs)
    if not measured or len({len(mark) for mark in marks}) > 1:
        return logs
    mean = np.average(marks, axis=0, weights=[len(log.episode_length) for log in logs])
    if np.abs(marks - mean).max() > MEASURED * mean[-1]:
        return logs
    return [
        dataclasses.replace(
            log,
            meta={
                **log.meta,
                "keypoint_arclength_m": mean.tolist(),
                "cable": {**log.meta["cable"], "length_m": float(mean[-1])},
            },
        )
        for log in logs
    ]


def _guessed(log: GapLog) -> list[Any]:
    """Names of the cable's values that were guessed; another program may mean something else by this field."""
    names = log.meta.get("guessed")
    return names if isinstance(names, list) and all(isinstance(name, str) for name in names) else []


def _labels(logs: Sequence[GapLog], names: Sequence[str], field: str) -> list[Any] | None:
    """A label of all episodes, by its log; its number where it has none (no split: ""). None where no log has any."""
    every: list[Any] = []
    found = False
    for log, name in zip(logs, names, strict=True):
        own, episodes = log.meta.get(field), len(log.episode_length)
        if isinstance(own, list) and len(own) == episodes:
            found = True
        else:
            own = [""] * episodes if field == "split" else list(range(episodes))
        every += own if field == "split" else [f"{name}: {value}" for value in own]
    return every if found else None


def chosen(log: GapLog, episodes: Sequence[int]) -> GapLog:
    """Some episodes of a log, for example without one that went wrong.

    Lists in `meta` beyond the format's own that have one entry per episode are of the episodes, and are shortened with
    them.

    Args:
        log: in the plane or in space.
        episodes: their numbers, increasing, at least one.

    Raises:
        GapLogError: numbers that the log does not have, or in another order.
    """
    total, numbers = len(log.episode_length), list(episodes) if np.ndim(episodes) else []
    whole = all(number in LIMITS["count_from_zero"] for number in numbers)
    if not numbers or not whole or numbers != sorted({*numbers} & {*range(total)}):
        raise GapLogError(
            f"The episodes {shown(episodes)} were asked for, expected increasing numbers below {total}, whole ones."
        )
    meta = dict(log.meta)
    for name, value in log.meta.items():
        of_cable = name in META_FIELDS or name == "guessed"
        if name == "motion" or (not of_cable and isinstance(value, list) and len(value) == total):
            meta[name] = [value[number] for number in numbers]
    if "recordings" in log.meta:
        parts = recordings(log)
        owner = np.repeat(np.arange(len(parts)), [part["episodes"] for part in parts])[numbers]
        counts = np.bincount(owner, minlength=len(parts))
        meta["recordings"] = [part | {"episodes": int(n)} for part, n in zip(parts, counts, strict=True) if n]
    every = episodes_of(log)
    return stack_episodes([every[number] for number in numbers], meta, holds=log.hold is not None)


def recordings(log: GapLog, name: str = "the log") -> list[dict[str, Any]]:
    """The recordings that a log was joined from, as `{"name", "episodes"}`; a log that was not joined has one, `name`.

    Raises:
        GapLogError: the field `recordings` of its `meta` does not add up to its episodes.
    """
    parts, episodes = log.meta.get("recordings"), len(log.episode_length)
    if parts is None:
        return [{"name": name, "episodes": episodes}]
    try:
        counts = [part["episodes"] for part in parts if isinstance(part["name"], str)]
        fits = len(counts) == len(parts) and sum(counts) == episodes and all(type(n) is int and n > 0 for n in counts)
    except (TypeError, KeyError, ValueError):
        fits = False
    if not fits:
        raise GapLogError(
            f"Field 'meta.recordings' is {shown(parts)}, expected names and numbers of episodes that add up to "
            f"{episodes}, as `cablejax.gaplog_join.joined` writes them."
        )
    return parts


def _set_up(log: GapLog) -> dict[str, Any]:
    """What recordings of one set-up have in common, by the names of the format."""
    meta = log.meta
    return {
        "dimension of the keypoints": log.keypoints.shape[3],
        "number of keypoints": log.keypoints.shape[2],
        "number of grippers": log.gripper_pose.shape[2],
        "meta.cable.rest_curvature_per_m": 0.0,
        **{f"meta.cable.{name}": value for name, value in meta["cable"].items()},
        **{f"meta.{name}": meta[name] for name in ("table", "gravity_m_per_s2", "keypoint_arclength_m", "grasp")},
    }
