"""Writes cases and locks their labels.

A label is published only as the SHA-256 of a random salt and the label's JSON; the salt is in the label's file, so that
anybody can check afterwards that no label was changed, and nobody can guess one before.
"""

from __future__ import annotations

import hashlib
import json
import os
import pathlib
import secrets
from typing import Any

import numpy as np

from cablejax.gaplog import SCHEMA, GapLog, write_gap_log

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
    """`out/<name>.npz` and `labels/locked/<name>.json`; the label last, as it marks the case as done."""
    log, label = noisy_log(case, draft, seed)
    name = case.name(seed)
    write_gap_log(out / f"{name}.npz", log, overwrite=True)
    locked = {"salt": secrets.token_hex(16), "label": label}
    _write_whole(labels / "locked" / f"{name}.json", json.dumps(locked, indent=1))


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
    return (out / f"{name}.npz").exists() and (labels / "locked" / f"{name}.json").exists()


def digest(locked: dict[str, Any]) -> str:
    """Hash of a locked label: SHA-256 of the salt and the label as JSON with sorted keys."""
    text = locked["salt"] + json.dumps(locked["label"], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def publish_hashes(labels: pathlib.Path) -> int:
    """Writes `labels/hashes.json` from every label there is, and returns their number."""
    hashes = {
        path.stem: digest(json.loads(path.read_text())) for path in sorted((labels / "locked").glob("????????.json"))
    }
    _write_whole(labels / "hashes.json", json.dumps(hashes, indent=0, sort_keys=True) + "\n")
    return len(hashes)


def read_labels(labels: pathlib.Path, published: list[pathlib.Path] | None = None) -> dict[str, dict[str, Any]]:
    """All labels whose hashes were published, each checked against its hash; others are left out.

    Args:
        labels: folder of `locked/`, and of `hashes.json` where nothing else was published.
        published: files of hashes that were published before; together they hold every case.

    Raises:
        ValueError: a label was changed or lost since the hashes were published.
    """
    hashes: dict[str, str] = {}
    for path in published or [labels / "hashes.json"]:
        hashes |= json.loads(path.read_text())
    found = {path.stem: json.loads(path.read_text()) for path in (labels / "locked").glob("????????.json")}
    if lost := sorted(set(hashes) - set(found)):
        raise ValueError(f"{len(lost)} cases have a published hash but no label: {lost[:5]} ...")
    for name, published_hash in hashes.items():
        if digest(found[name]) != published_hash:
            raise ValueError(f"The label of {name} does not fit its published hash: it was changed afterwards.")
    return {name: found[name]["label"] for name in sorted(hashes)}


def _write_whole(path: pathlib.Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    os.replace(temporary, path)


def write_open_labels(out: pathlib.Path, labels: dict[str, dict[str, Any]]) -> None:
    """`labels.json` beside the logs, for a development set that is not blind."""
    _write_whole(out / "labels.json", json.dumps(labels, indent=1) + "\n")
