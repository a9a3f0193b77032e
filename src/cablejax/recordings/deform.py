"""Recordings of the DEFORM data set: three-dimensional motion capture of cables held at both ends and moved fast.

Chen, Zhang, Brei, Zhang, Chen, Wu and Vasudevan, "Differentiable discrete elastic rods for real-time modeling of
deformable linear objects", CoRL 2024, arXiv 2406.05931. Upstream keeps a folder per cable with the folders `train` and
`eval`, and in them one pickle per block of a recording, named by a number. This reads those pickles, and an `.npz` of
all blocks of one cable.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import pathlib
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cablejax.limits import shown
from cablejax.npz import read_npz
from cablejax.recordings.assemble import Nominal, gap_log_from_takes
from cablejax.recordings.frames import Frame
from cablejax.recordings.pickles import read_pickle
from cablejax.recordings.prepare import Setup, prepare, repaired
from cablejax.recordings.take import Take
from cablejax.types import GapLog

SAMPLE_INTERVAL = 0.01
"""Seconds between two samples of the data set; its pickles hold no times."""

ADJOINING = 0.05
"""Largest distance [m] of any marker from the last sample of a block to the first of the next, within a recording."""


@dataclasses.dataclass(frozen=True)
class DeformRecordings:
    """All blocks of one cable, as they were published: nothing in them is repaired.

    Attributes:
        keypoints: markers [m], z up, shape [W, T, N, 3]; NaN after the end of a block shorter than the longest.
        dt: sample interval [s].
        split: "train" or "eval" as upstream has it, or "" for a block outside of both, shape [W].
        recording: number of the recording that a block is part of: blocks with following numbers that continue each
            other are one, shape [W].
        source_id: number that names the block's file, shape [W].
        name: the cable.
    """

    keypoints: Float[np.ndarray, "W T N 3"]
    dt: float
    split: np.ndarray
    recording: np.ndarray
    source_id: np.ndarray
    name: str

    def __post_init__(self):
        shape = self.keypoints.shape
        if len(shape) != 4 or shape[3] != 3 or shape[2] < 5 or shape[0] < 1 or shape[1] < 2:
            raise ValueError(
                f"{self.name}: keypoints has shape {shape}, expected [W, T, N, 3] with at least two samples and five "
                "markers: two on each gripper and one between."
            )
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"{self.name}: dt is {self.dt}, expected a sample interval in seconds.")
        for field in ("split", "recording", "source_id"):
            if getattr(self, field).shape != shape[:1]:
                raise ValueError(
                    f"{self.name}: {field} has shape {getattr(self, field).shape}, expected ({shape[0]},): one per "
                    f"block."
                )
        if unknown := sorted(set(self.split.tolist()) - {"train", "eval", ""}):
            raise ValueError(
                f"{self.name}: split has {shown(unknown[0])}, expected train, eval, which is never fitted, or nothing."
            )

    def chosen(self, index: Int[np.ndarray, " S"]) -> DeformRecordings:
        """Some of the blocks."""
        parts = {f: getattr(self, f)[index] for f in ("keypoints", "split", "recording", "source_id")}
        return dataclasses.replace(self, **parts)


def read_deform(path: str | os.PathLike[str]) -> DeformRecordings:
    """Reads the recordings of one cable, in double precision and in the order of their numbers.

    Args:
        path: an `.npz` file with `keypoints` [W, T, N, 3], `dt`, `split`, `source_id` and `recording_guess`; or
            upstream's folder of one cable, with pickles in `train/` and `eval/`; or one pickle.

    Raises:
        ValueError: there is nothing of the kind, a pickle holds anything but arrays of numbers, or shapes do not fit.
        FileNotFoundError: there is no such file.
    """
    path = pathlib.Path(path)
    if path.is_dir():
        found = [*path.glob("*.pkl"), *path.glob("*/*.pkl")]
        # hidden ones are not recordings: other systems leave some in copied folders
        return _read_pickles(path, sorted(file for file in found if not file.name.startswith(".")))
    if path.suffix.lower() == ".npz":
        return _read_npz(path)
    if path.suffix.lower() in (".pkl", ".pickle"):
        return _read_pickles(path, [path])
    raise ValueError(f"{path} is neither an .npz file, a .pkl file nor a folder of .pkl files.")


def _read_npz(path: pathlib.Path) -> DeformRecordings:
    arrays = read_npz(path, ["keypoints", "dt", "split", "source_id", "recording_guess"], text=["split"])
    for name in ("source_id", "recording_guess"):
        if not np.issubdtype(arrays[name].dtype, np.integer):
            raise ValueError(f"{path}: {name} is {arrays[name].dtype}, expected whole numbers.")
    if not np.issubdtype(arrays["keypoints"].dtype, np.floating):
        raise ValueError(f"{path}: keypoints is {arrays['keypoints'].dtype}, expected floating point numbers.")
    if arrays["dt"].size != 1:
        raise ValueError(f"{path}: dt has shape {arrays['dt'].shape}, expected one number.")
    return DeformRecordings(
        keypoints=arrays["keypoints"].astype(float),
        # Single precision writes 0.01 as 0.0099999998.
        dt=round(float(arrays["dt"].item()), 7),
        split=arrays["split"].astype(str),
        recording=arrays["recording_guess"].astype(int),
        source_id=arrays["source_id"].astype(int),
        name=path.stem,
    )


def _read_pickles(path: pathlib.Path, files: list[pathlib.Path]) -> DeformRecordings:
    if not files:
        raise ValueError(f"{path} has no .pkl files, expected upstream's folder of one cable with train/ and eval/.")
    if unnamed := [file.name for file in files if not file.stem.isdecimal()]:
        raise ValueError(f"{path}: {unnamed[0]} is not named by a number, expected names such as 89.pkl.")
    files = sorted(files, key=lambda file: int(file.stem))
    numbers = [int(file.stem) for file in files]
    if repeated := [a for a, b in itertools.pairwise(numbers) if a == b]:
        raise ValueError(f"{path} has {repeated[0]}.pkl twice, expected each block in one folder only.")
    blocks = [_block(file, read_pickle(file)) for file in files]
    counts = [block.shape[1] for block in blocks]
    if len(set(counts)) > 1:
        most = max(set(counts), key=counts.count)
        odd = next(file for file, count in zip(files, counts, strict=True) if count != most)
        raise ValueError(
            f"{odd} has {counts[files.index(odd)]} markers where the others have {most}: a gripper's pair is missing, "
            "or it is another cable. Leave the file out, or import each cable separately."
        )
    longest = max(map(len, blocks))
    keypoints = np.full((len(blocks), longest, counts[0], 3), np.nan)
    for row, block in zip(keypoints, blocks, strict=True):
        row[: len(block)] = block
    return DeformRecordings(
        keypoints=keypoints,
        dt=SAMPLE_INTERVAL,
        split=np.array([file.parent.name if file.parent.name in ("train", "eval") else "" for file in files]),
        recording=_group(blocks, numbers),
        source_id=np.array(numbers),
        name=path.stem,
    )


def _block(file: pathlib.Path, value: Any) -> Float[np.ndarray, "T N 3"]:
    try:
        block = np.array(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{file} holds {type(value).__name__}, expected positions of shape (T, 3, N).") from None
    if block.ndim == 3 and block.shape[1] == 3:  # as upstream has it: the coordinate before the marker
        block = block.transpose(0, 2, 1)
    if block.ndim != 3 or block.shape[2] != 3 or len(block) < 2:
        raise ValueError(f"{file} has positions of shape {block.shape}, expected (T, 3, N) or (T, N, 3).")
    return block


def _group(blocks: list[np.ndarray], numbers: list[int]) -> np.ndarray:
    """Numbers the recordings: a block is of the one before if it has the next number and begins where that ends."""
    recording = np.zeros(len(blocks), int)
    for index in range(1, len(blocks)):
        step = np.linalg.norm(blocks[index][0] - blocks[index - 1][-1], axis=-1)
        seen = step[np.isfinite(step)]
        follows = numbers[index] == numbers[index - 1] + 1 and seen.size > 0 and seen.max() < ADJOINING
        recording[index] = recording[index - 1] + (not follows)
    return recording


_TEXTBOOK_MODULUS = 1e7
_DIAMETER = 0.006
NOMINAL = Nominal(
    diameter=_DIAMETER,
    linear_density=1300.0 * np.pi * _DIAMETER**2 / 4,
    bending_stiffness=_TEXTBOOK_MODULUS * np.pi * _DIAMETER**4 / 64,
    guessed=("diameter_m", "linear_density_kg_per_m", "bending_stiffness_n_m2"),
)
"""A solid round cord of soft PVC or rubber, 6 mm thick: 10 MPa and 1300 kg/m^3 from tables. All of it is guessed.
Motion under prescribed ends shows only EI per mass and length, here 0.017 m^4/s^2; neither of the two by itself."""


def takes_of(recordings: DeformRecordings) -> tuple[Take, ...]:
    """One take per block, with its split, recording and file number as labels."""
    takes = []
    for index, points in enumerate(recordings.keypoints):
        seen = np.flatnonzero(np.isfinite(points).any(axis=(1, 2)))
        points = points[: seen[-1] + 1]
        takes.append(
            Take(
                name=str(recordings.source_id[index]),
                time=recordings.dt * np.arange(len(points)),
                keypoints=points,
                labels={
                    "split": str(recordings.split[index]),
                    "recording": int(recordings.recording[index]),
                    "file": int(recordings.source_id[index]),
                },
            )
        )
    return tuple(takes)


def import_deform(
    path: str | os.PathLike[str], *, unit: str | None = None, frame: Frame = Frame()
) -> tuple[GapLog, list[str]]:
    """Reads, checks and repairs the recordings of one cable.

    Args:
        path: as for `read_deform`.
        unit: of length; None = metres, or another one where the length of the cable leaves no doubt.
        frame: the frame of the positions; upstream's has z up.

    Returns:
        A gap log in space, and a sentence on each repair. Its `meta` has, per episode, the `take`, upstream's `split`,
        the `recording` and the number of the `file`.

    Raises:
        ValueError: nothing that can be read, or used without guessing.
    """
    recordings, left_out = _seen(read_deform(path))
    takes, repairs = prepare(takes_of(recordings), Setup(unit=unit, frame=frame, on_grippers="pairs"))
    repairs = [*left_out, *repairs]
    source = (
        f"{recordings.name} of the DEFORM data set (Chen et al., CoRL 2024, arXiv 2406.05931). The length is measured "
        "along the markers, which sit off the centreline. Diameter, linear density and bending stiffness are guesses: "
        "only bending stiffness per linear density shows. Gripper poses are from two markers each, their roll is not "
        "observed; commands are differences of these poses."
    )
    return gap_log_from_takes(takes, NOMINAL, source=source, repairs=repairs), repairs


def repaired_blocks(recordings: DeformRecordings) -> tuple[DeformRecordings, list[str]]:
    """The blocks after the checks and repairs of an import that leave every sample where it is: none is cut.

    For whoever scores whole blocks, as upstream does.

    Returns:
        Blocks with markers in metres, in their order, NaN where a reading cannot be right; and a sentence on each
        repair.

    Raises:
        ValueError: as `import_deform`.
    """
    recordings, left_out = _seen(recordings)
    takes, repairs = repaired(takes_of(recordings), Setup(unit=None))
    points = np.full_like(recordings.keypoints, np.nan)
    for row, take in zip(points, takes, strict=True):
        row[: len(take.keypoints)] = take.keypoints
    return dataclasses.replace(recordings, keypoints=points), [*left_out, *repairs]


def _seen(recordings: DeformRecordings) -> tuple[DeformRecordings, list[str]]:
    """The blocks with an observed position, and a sentence on those without."""
    seen = np.isfinite(recordings.keypoints).any(axis=(1, 2, 3))
    if seen.all():
        return recordings, []
    if not seen.any():
        raise ValueError(f"{recordings.name}: no block has an observed position: expected markers' positions.")
    empty = ", ".join(map(str, recordings.source_id[~seen]))
    return recordings.chosen(np.flatnonzero(seen)), [f"Block {empty} has no observed position: left out."]
