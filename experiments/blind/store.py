"""Writes cases and hashes of their labels; everything about a case is a row with its `name` in files of JSON lines.

A label is published only as `hash`, the SHA-256 of a random salt and the label's JSON. `salt` and `label` stay in a
private file until the diagnosis has run, and are published then: everybody can check that no label was changed, and
nobody can guess one before. A finished set is one file, whose rows have `name`, `hash`, `salt`, `label` and verdicts.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import pathlib
import secrets
from collections.abc import Iterable
from typing import Any

import numpy as np

from cablejax.gaplog import SCHEMA, GapLog, write_gap_log
from cablejax.text_file import write_json
from cablejax.whole_file import whole_file
from rows import Rows, append_row

from .cases import Draft, label_of
from .motions import INTERVAL
from .observe import KEYPOINTS
from .plan import Case
from .world import GRAVITY

POSE_NOISE = np.array([3e-5, 3e-5, 1.5e-4])
"""Of the encoders [m, m, rad]."""
MISSING_LOGS, MISSING = 0.15, 0.01
"""Share of the logs that miss keypoints, and share of the keypoints they miss."""


def write_case(case: Case, draft: Draft, seed: int, out: pathlib.Path, labels: pathlib.Path) -> None:
    """`out/<name>.npz` and a row of the file `labels`; the label last, as it marks the case as done.

    A log that was lost is made again; its label stays, and with it the hash that may be published.
    """
    log, label = noisy_log(case, draft, seed)
    name = case.name(seed)
    write_gap_log(out / f"{name}.npz", log, overwrite=True)
    if name not in read_cases([labels]):
        append_row(labels, {"name": name, "salt": secrets.token_hex(16), "label": label})


def noisy_log(case: Case, draft: Draft, seed: int) -> tuple[GapLog, dict[str, Any]]:
    """The log as a camera and the encoders report it, and its label."""
    rng = np.random.default_rng([seed, case.index, 1000])
    gaps = MISSING if rng.random() < MISSING_LOGS else 0.0
    noisy = []
    for keypoints in draft.after.keypoints:
        seen = keypoints + draft.noise * rng.standard_normal(keypoints.shape)
        seen[rng.random(seen.shape[:2]) < gaps] = np.nan
        noisy.append(seen)
    poses = [pose + POSE_NOISE * rng.standard_normal(pose.shape) for pose in draft.after.pose]
    lengths = np.array([len(pose) for pose in poses], np.int32)
    count, longest, world = len(poses), int(lengths.max()), draft.world
    hold = np.zeros((count, longest), np.bool_)
    log = GapLog(
        time=np.empty((count, longest)),
        keypoints=np.full((count, longest, KEYPOINTS, 2), np.nan, np.float32),
        gripper_pose=np.empty((count, longest, 2, 3), np.float32),
        gripper_command=np.zeros((count, longest, 2, 3), np.float32),
        episode_length=lengths,
        hold=hold,
        meta={
            "schema": SCHEMA,
            "cable": {
                "length_m": world.length, "diameter_m": world.diameter,
                "linear_density_kg_per_m": world.linear_density, "bending_stiffness_n_m2": world.stiffness,
                "bending_damping_s": world.damping_time,
            },
            "table": {"friction_coefficient": world.friction},
            "gravity_m_per_s2": [0.0, 0.0, -GRAVITY],
            "keypoint_arclength_m": np.linspace(0.0, world.length, KEYPOINTS).round(9).tolist(),
            "grasp": ["clamped", "clamped"],
            "motion": [commands.motion for commands in draft.commands],
            "source": "blind case",
        },
    )  # fmt: skip
    for episode, (length, commands) in enumerate(zip(lengths, draft.commands, strict=True)):
        log.time[episode, :length] = INTERVAL * np.arange(length)
        log.time[episode, length:] = INTERVAL * (length - 1)
        log.keypoints[episode, :length] = noisy[episode]
        log.gripper_pose[episode, :length] = poses[episode]
        log.gripper_pose[episode, length:] = poses[episode][-1]
        log.gripper_command[episode, :length] = commands.twist
        hold[episode, :length] = commands.hold
    return log, label_of(case, draft, seed, noisy)


def is_done(name: str, out: pathlib.Path, labels: pathlib.Path) -> bool:
    """Whether a case need not be made again."""
    return (out / f"{name}.npz").exists() and name in read_cases([labels])


def digest(locked: dict[str, Any]) -> str:
    """Hash of a locked label: SHA-256 of the salt and the label as JSON with sorted keys."""
    text = locked["salt"] + json.dumps(locked["label"], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def publish_hashes(labels: pathlib.Path, published: pathlib.Path) -> int:
    """Adds the hashes of all labels to the rows of the file `published`, and returns the number of labels.

    The rows are sorted by name, since the order of making says what a case is.

    Raises:
        ValueError: another hash of a case is published already.
    """
    with open(labels, "a+b") as turn:  # one process at a time
        fcntl.flock(turn, fcntl.LOCK_EX)
        locked = read_cases([labels])
        hashes = {name: {"name": name, "hash": digest(row)} for name, row in locked.items()}
        write_cases(published, _merged([read_cases([published]), hashes]))
    return len(locked)


def read_cases(paths: Iterable[pathlib.Path]) -> dict[str, dict[str, Any]]:
    """The rows of some files by the cases' names, sorted; what several files say of a case is put together.

    Raises:
        ValueError: two files say different things.
    """
    return _merged([{row["name"]: row for row in Rows(path, ("name",)).read()} for path in paths])


def write_cases(path: pathlib.Path, cases: dict[str, dict[str, Any]]) -> None:
    """Writes a file of rows, whole, over what was there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as stream:
        stream.write("".join(json.dumps(row, allow_nan=False) + "\n" for row in cases.values()).encode())


def checked_labels(cases: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """All labels whose hashes were published, each checked against its hash; others are left out.

    Raises:
        ValueError: a label was changed or lost since the hashes were published.
    """
    published = {name: row for name, row in cases.items() if "hash" in row}
    if lost := [name for name, row in published.items() if "label" not in row]:
        raise ValueError(f"{len(lost)} cases have a published hash but no label: {lost[:5]} ...")
    for name, row in published.items():
        if digest(row) != row["hash"]:
            raise ValueError(f"The label of {name} does not fit its published hash: it was changed afterwards.")
    return {name: row["label"] for name, row in published.items()}


def _merged(parts: Iterable[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    merged: dict[str, dict[str, Any]] = {}
    for part in parts:
        for name, row in part.items():
            known = merged.setdefault(name, {})
            if differing := [field for field in row if known.get(field, row[field]) != row[field]]:
                raise ValueError(f"Files say different things of case {name}: {differing}. Give the right one only.")
            known |= row
    return dict(sorted(merged.items()))


def write_open_labels(out: pathlib.Path, labels: dict[str, dict[str, Any]]) -> None:
    """`labels.json` beside the logs, for a development set that is not blind."""
    write_json(out / "labels.json", labels)
