"""Scores real cables open loop: each step of the diagnosis by recording, and upstream's eval split.

    python experiments/30_real_cables.py --data $CABLEJAX_DATA/deform

reads every cable of a folder of recordings, here DLO1.npz to DLO3.npz (public data of Chen et al., CoRL 2024, arXiv
2406.05931), and writes docs/results/real_cables.md with its figure. `--data` is a folder of .npz files, or of folders
of .pkl files as upstream has them. Recordings are checked and repaired as `cablejax import deform` does. A cable that
it would refuse is named on the page with the reason, and the others are scored. Published figures are read from a table
(`--published`): one line for each method, one column for each cable, in millimetres. All choices are made by leaving
out recordings of the train split; the eval split, where there is one, is scored once, at the end. Resumes after an
interruption.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import os
import pathlib
import sys

import cablejax
from cablejax.recordings.deform import DeformRecordings, read_deform, repaired_blocks
from pages import publish
from real_cables.benchmark import score_cable
from real_cables.page import Notes, errors_figure, page, read_published
from real_cables.protocol import cables_in, protocol_windows
from rows import Rows, made_on

_PACKAGE = pathlib.Path(cablejax.__file__).parent
# Whose code decides a score: one of an earlier fit is not printed as today's.
_SCORING = [
    _PACKAGE / "recordings" / "deform.py",
    *(file for room in ("bounded", "diagnose", "simulate/rod", "spatial") for file in (_PACKAGE / room).glob("*.py")),
    *(
        pathlib.Path(__file__).parent / "real_cables" / f"{name}.py"
        for name in ("benchmark", "features", "known", "network", "protocol", "residual")
    ),
]
_PUBLISHED = pathlib.Path(__file__).parent / "real_cables" / "published.csv"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=pathlib.Path, required=True, help="folder of recorded cables")
    parser.add_argument("--published", type=pathlib.Path, default=_PUBLISHED, help="table of published errors, .csv")
    parser.add_argument("--cache", type=pathlib.Path, default=pathlib.Path("runs/real_cables"))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/results/real_cables.md"))
    parser.add_argument(
        "--figure", type=pathlib.Path, help="default: images/NAME.png of the folder above that of --out"
    )
    arguments = parser.parse_args()
    read, repairs, refused = _read(arguments.data)
    published = read_published(arguments.published)

    def scored(cable: str, digest: str):
        state = arguments.cache / digest
        state.mkdir(parents=True, exist_ok=True)
        score = score_cable(
            read[cable],
            state=state,
            progress=lambda text: print(f"{cable}: {text}", file=sys.stderr, flush=True),
        )
        return dataclasses.asdict(score)

    rows, keys = Rows(arguments.cache / "errors.jsonl", ("cable", "recordings")), list(map(_key, read.values()))
    rows.run(rows.missing(keys), scored)
    scores = {row["cable"]: row for row in rows.read() if (row["cable"], row["recordings"]) in keys}
    scores = {cable: scores[cable] for cable in read}
    out = arguments.out
    picture = arguments.figure or out.parent.parent / "images" / f"{out.stem}.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    errors_figure(scores, published, picture)
    notes = Notes(repairs, refused)
    publish(page(scores, published, os.path.relpath(picture, out.parent), made_on(rows.path), notes), out)


def _read(folder: pathlib.Path) -> tuple[dict[str, DeformRecordings], dict[str, list[str]], dict[str, str]]:
    """The cables that can be scored, what was repaired in each, and why others cannot be scored.

    Raises:
        ValueError: no cable can be scored.
    """
    read, repairs, refused = {}, {}, {}
    for name, path in cables_in(folder).items():
        try:
            recordings = dataclasses.replace(read_deform(path), name=name)
            recordings, found = repaired_blocks(recordings)
            windows = protocol_windows(recordings)
            if len(windows) == 1 or windows.split.count("eval") == len(windows) - 1:
                raise ValueError("One block may be fitted, expected at least two, so that one can be left out.")
            read[name], repairs[name] = recordings, found
        except ValueError as error:
            refused[name] = str(error)
            print(f"{name} is not scored: {error}", file=sys.stderr, flush=True)
    if not read:
        raise ValueError(f"No cable in {folder} can be scored: " + " ".join(refused.values()))
    return read, repairs, refused


def _key(recordings: DeformRecordings) -> tuple[str, str]:
    """The cable's name and a hash of its recordings and of the code that scores them."""
    digest = hashlib.sha256(repr((recordings.keypoints.shape, recordings.dt, recordings.split.tolist())).encode())
    for array in (recordings.keypoints, recordings.recording, recordings.source_id):
        digest.update(array.tobytes())
    for source in sorted(_SCORING):
        digest.update(source.read_bytes())
    return recordings.name, digest.hexdigest()[:16]


if __name__ == "__main__":
    main()
