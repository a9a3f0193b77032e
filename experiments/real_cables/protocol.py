"""Reads folders of recorded cables, and cuts them by the protocol of Chen et al. (2024): every block is a window."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
from jaxtyping import Float

from cablejax.recordings.deform import DeformRecordings
from cablejax.recordings.gaps import bridged
from cablejax.recordings.take import median_step
from cablejax.simulate.rod.clamps import frames_along
from cablejax.spatial.windows import Windows

# Quantile of a spacing over all samples that is taken for the arc length between two markers: where it is straight.
_STRAIGHT = 0.75
_JUMP = 0.002
# Markers on the grippers are interpolated over a gap up to this long; a longer one ends the window [s].
_GAP = 0.1
_HELD = [0, 1, -2, -1]


def cables_in(path: pathlib.Path) -> dict[str, pathlib.Path]:
    """The cables of a folder by name, in the order of their names.

    Args:
        path: a folder of `.npz` files, or of folders, one for each cable, that hold pickles (in `train/` and `eval/` or
            by themselves) or an `.npz` file; or one such cable.

    Raises:
        ValueError: there is no recording.
    """
    if path.suffix.lower() in (".npz", ".pkl", ".pickle") and path.is_file():
        return {path.stem: path}
    if any(path.glob("*.pkl")) or any(folder.name in ("train", "eval") for folder in path.glob("*/")):
        return {path.resolve().name: path}
    found = {file.stem: file for file in path.glob("*.npz")}
    for folder in path.glob("*/"):
        files = [*folder.glob("*.npz")]
        if [*folder.glob("*.pkl"), *folder.glob("*/*.pkl")]:
            found[folder.name] = folder
        elif files:
            found |= {folder.name if len(files) == 1 else f"{folder.name} {file.stem}": file for file in files}
    if not found:
        raise ValueError(
            f"{path} holds no recording, expected .npz files, or a folder of .pkl files or an .npz file for each cable."
        )
    return dict(sorted(found.items()))


def protocol_windows(recordings: DeformRecordings) -> Windows:
    """Every block as one window. Samples after a jump in time, or after the grippers were not seen for 0.1 s, are not
    fitted nor scored by `Windows.valid`, but simulated through. A block that does not begin with two samples of all
    markers, or of which a short gap does not show them, is left out.

    Args:
        recordings: checked and repaired, see `repaired_blocks`.

    Raises:
        ValueError: neighbouring markers are never observed together, or no block begins with two whole samples.
    """
    points = recordings.keypoints
    held, count = _followed(points[:, :, _HELD], recordings.dt)
    step = np.stack([median_step(block) for block in points])
    padded = np.pad(step, ((0, 0), (1, 1)))
    jump = step > 2 * np.maximum(padded[:, :-2], padded[:, 2:]) + _JUMP
    count = np.where(jump.any(axis=1), np.minimum(jump.argmax(axis=1) + 1, count), count)
    points = points.copy()
    points[:, :2] = [bridged(block, recordings.dt)[:2] for block in points]
    whole = np.isfinite(points[:, :2]).all(axis=(1, 2, 3))
    if not whole.any():
        raise ValueError(f"{recordings.name}: no block begins with two samples of all markers.")
    tangent = np.stack([held[:, :, 1] - held[:, :, 0], held[:, :, 3] - held[:, :, 2]], axis=2)
    tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    fitted = recordings.split != "eval"
    spacing = np.linalg.norm(np.diff(points[fitted if fitted.any() else ~fitted][:, ::5], axis=2), axis=-1)
    if (unseen := ~np.isfinite(spacing).any(axis=(0, 1))).any():
        k = int(unseen.argmax())
        raise ValueError(f"{recordings.name}: markers {k} and {k + 1} are never observed together: leave one out.")
    lengths = np.nanquantile(spacing.reshape(-1, spacing.shape[-1]), _STRAIGHT, axis=0)[1:-1]
    every = Windows(
        keypoints=points[:, :, 2:-2],
        position=held[:, :, [1, 2]],
        frames=np.stack([frames_along(tangent[:, :, q]) for q in range(2)], axis=2),
        valid=np.arange(points.shape[1]) < count[:, None],
        interval=recordings.dt,
        episode=np.arange(len(points)),
        begin=np.zeros(len(points), int),
        group=recordings.recording,
        trust=np.ones(len(points)),
        split=tuple(recordings.split),
        name=tuple(str(n) for n in recordings.source_id),
        held=(2, 2),
        arclength=np.cumsum(lengths),
        n_keypoints=points.shape[2],
    )
    left_out = tuple(f"file {every.name[i]}" for i in np.flatnonzero(~whole))
    return dataclasses.replace(every.chosen(np.flatnonzero(whole)), left_out=left_out)


def _followed(held: Float[np.ndarray, "W T 4 3"], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """The markers on the grippers at every sample, and how many samples of each window these are known."""
    samples, most = np.arange(held.shape[1]), round(_GAP / dt)
    seen = np.asarray(np.isfinite(held).all(axis=(2, 3)))
    since = samples - np.maximum.accumulate(np.where(seen, samples, -1), axis=1)
    last = np.where(seen, samples, -1).max(axis=1)
    lost = since > most
    count = np.minimum(np.where(lost.any(axis=1), lost.argmax(axis=1) - most, len(samples)), last + 1)
    filled = held.copy()
    for block, there in zip(filled.reshape(*held.shape[:2], -1), seen, strict=True):
        if there.any():
            block[:] = np.stack([np.interp(samples, samples[there], column[there]) for column in block.T], axis=1)
    return filled, np.maximum(count, 0)
