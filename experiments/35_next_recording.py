"""Tests whether the next recording of a cable in space, chosen by its expected information, beats a random one.

    python experiments/35_next_recording.py --data $CABLEJAX_DATA/deform --executor 2     # resumable
    python experiments/35_next_recording.py --seeds 12 --executor 2                       # synthetic cables
    python experiments/35_next_recording.py --report docs/results/next_recording.md

Recorded motion is replayed. A cable is estimated from three windows of 5 s, drawn from the train split. Twelve other
windows of that split are candidates for the next recording. Before a candidate is looked at, its expected information
about the parameters is computed from the motion of its clamps alone: what the fit leaves open, sent through the
simulator's derivatives, over the error of a good fit; the recording's own grip is not a parameter of interest. Then the
cable is fitted with each candidate in turn, and scored on upstream's eval split. Synthetic cables, whose stiffness is
known, are treated alike.

One candidate is chosen by the information, and one by a simple rule: the motion whose clamps move fastest. Random
choice scores the candidates' mean, and the best in hindsight is the best of them.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import os
import pathlib
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("NPROC", "4")
# with more threads rods of more than 32 edges take longer by far
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from cablejax.diagnose.information import parameter_information
from cablejax.recordings.deform import NOMINAL, read_deform, repaired_blocks
from cablejax.simulate.rod import Rod
from cablejax.spatial.cable import SpatialCable
from cablejax.spatial.effects import GRIP
from cablejax.spatial.estimate import Estimate, estimate
from cablejax.spatial.identify import EDGES, identify
from cablejax.spatial.windows import Windows
from executors import add_option, executor_of
from pages import markdown_table, page_of_results, publish
from real_cables.benchmark import errors_of, shared_only
from real_cables.protocol import cables_in, protocol_windows
from real_cables.synthetic import synthetic_recordings
from rows import Rows, made_on

FIRST, CANDIDATES = 3, 12
"""Windows that are known at first, and windows that the next one is chosen from."""
SEED = 35
SYNTHETIC, FIRST_CABLE = "synthetic", 2000
"""Cables of known stiffness, by both simulators of `34_fresh_cables.py` in turn, and the seed of the first."""
ROWS = pathlib.Path("docs") / "results" / "trials" / "next_recording.jsonl"


def information(cable: SpatialCable, found: Estimate) -> Float[np.ndarray, "W"]:
    """Expected information of recording each of the cable's windows about the parameters of an estimate [nats].

    What jackknife and priors leave open of the values is sent through the simulator's derivatives, and compared with
    the error of a good fit. The recording's own grip is not asked for. Only the motion of the clamps and the first two
    samples enter, not what the markers do then.

    Args:
        cable: in the windows that may be recorded.
        found: what is known.
    """
    left_open, grip = np.concatenate([found.moves, found.shifts]), cable.layout.slots("gripper_rotation_offset")
    rows, evidence = np.concatenate([left_open, GRIP * np.eye(cable.layout.size)[grip]]), cable.evidence()
    slopes = cable.along(shared_only(found.explanation), rows, evidence.episodes)[1] / evidence.noise
    seen = np.isfinite(evidence.observed) & np.isfinite(slopes).all(axis=0)
    flat = np.where(seen, slopes, 0.0).swapaxes(0, 1).reshape(len(seen), len(rows), -1)
    count = len(left_open)
    return np.array([parameter_information(each[:count], each[count:]) for each in flat])


def trial(data: str | None, name: str, seed: int) -> dict[str, Any]:
    """One cable from three windows, and with each candidate as the fourth."""
    rng, believed, truth = np.random.default_rng([SEED, seed]), NOMINAL.stiffness_over_density, None
    if name == SYNTHETIC:
        made = synthetic_recordings(FIRST_CABLE + seed, "richer" if seed % 2 else "composite", 24, 100)
        cable, (recordings, _) = made.cable, repaired_blocks(made.recordings)
        believed, truth, windows = cable.believed, math.log(cable.stiffness / cable.laden), protocol_windows(recordings)
        windows = dataclasses.replace(windows, split=("train",) * 16 + ("eval",) * (len(windows) - 16))
    else:
        assert data is not None
        recordings, _ = repaired_blocks(read_deform(cables_in(pathlib.Path(data))[name]))
        windows = protocol_windows(recordings)
    is_eval, whole = np.array(windows.split) == "eval", windows.whole(len(windows))
    drawn = rng.permutation(whole[~is_eval[whole]])[: FIRST + CANDIDATES]
    first, candidates = drawn[:FIRST], drawn[FIRST:]
    found = identify(windows.chosen(first), believed)
    known, checked = found.everything, found.cable.on(windows.chosen(np.flatnonzero(is_eval)))
    plain = dataclasses.replace(found.cable, rod=Rod(EDGES, 1, twisting=False), edges=())
    fitted = plain.finer(found.time_steps.substeps)
    gain = information(fitted.on(windows.chosen(candidates)), known)
    scored = [_score(checked, known)]
    for candidate in candidates:
        both = fitted.on(windows.chosen(np.append(first, candidate)))
        scored.append(_score(checked, estimate(both, [known.explanation], found.tried)))
    return {
        "windows": drawn.tolist(),
        "information_nats": gain.tolist(),
        "clamp_speed_m_per_s": [clamp_speed(windows.chosen([c])) for c in candidates],
        "true_log_stiffness": truth,
        **{f"before_{name}": value for name, value in scored[0].items()},
        **{f"after_{name}": [one[name] for one in scored[1:]] for name in scored[0]},
    }


def clamp_speed(windows: Windows) -> float:
    """Root mean square speed of the clamps [m/s]."""
    step = np.diff(np.where(windows.valid[:, :, None, None], windows.position, np.nan), axis=1) / windows.interval
    return float(np.sqrt(np.nanmean((step**2).sum(axis=-1))))


def _score(checked: SpatialCable, known: Estimate) -> dict[str, float]:
    """Mean error on unseen windows [mm], none counted beyond ten times the median; logarithms of EI / rho and of the
    ratio of its interval's ends."""
    predicted, stiffness = checked.motion(shared_only(known.explanation)), known.stiffness
    return {
        "mm": errors_of(predicted, checked.windows).mean,
        "log_stiffness": float(np.log(stiffness.value)),
        "log_interval": float(np.log(stiffness.high / stiffness.low)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", help="folder of recorded cables, .npz; without it, synthetic cables")
    parser.add_argument("--seeds", type=int, default=6, help="draws of windows for each cable, or synthetic cables")
    parser.add_argument("--rows", type=pathlib.Path, default=ROWS, help="file of the finished rows")
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    add_option(parser)
    options = parser.parse_args()
    rows = Rows(options.rows, ("cable", "seed"))
    if options.report is not None:
        publish(page(rows.read(), made_on(options.rows)), options.report)
        return
    names = [SYNTHETIC] if options.data is None else cables_in(pathlib.Path(options.data))
    wanted = [(name, seed) for seed in range(options.seeds) for name in names]
    with executor_of(options.executor) as executor:
        rows.run(rows.missing(wanted), functools.partial(trial, options.data), executor=executor)


def page(rows: Sequence[dict[str, Any]], made: str) -> str:
    """The tables, and what they are of."""
    real = [row for row in rows if row["cable"] != SYNTHETIC]
    known = [row | _off(row) for row in rows if row["cable"] == SYNTHETIC]
    lines = [
        f"{len(real)} draws of {FIRST} windows of 5 s from real cables, and {len(known)} synthetic cables estimated "
        f"from {FIRST} recordings of 1 s; the next recording is one of {CANDIDATES} others. `by information` is the "
        "one whose motion is expected to be most informative about the parameters, before its markers are seen; "
        "`fastest` the one whose clamps move fastest; `at random` the mean over all of them; `best` is the best in "
        "hindsight. Means over draws; of intervals, geometric ones.",
        "",
        "A next motion is recommended for a cable in space only once its information ranks candidates better than "
        "chance.",
        "",
    ]
    for title, of, field, mean in (
        ("Real cables: 90 % interval of EI/rho, upper end over lower end", real, "log_interval", np.exp),
        ("Real cables: error on upstream's eval split, grips unknown [mm]", real, "mm", float),
        ("Synthetic cables: EI/rho off the true value [%]", known, "off", float),
        ("Synthetic cables: error on unseen recordings, grips unknown [mm]", known, "mm", float),
    ):
        lines += [f"## {title}", "", *_table(of, field, mean), ""]
    made_by = (
        "`python experiments/35_next_recording.py --data $CABLEJAX_DATA/deform`, the same with `--seeds 12` and no "
        "`--data`, and `--report docs/results/next_recording.md`"
    )
    return page_of_results("The next recording of a cable in space", made_by, lines, made_on=made)


def _off(row: dict[str, Any]) -> dict[str, Any]:
    """By how much EI / rho is off the true value before and after [%]."""
    true = row["true_log_stiffness"]
    return {
        "before_off": 100 * abs(float(np.expm1(row["before_log_stiffness"] - true))),
        "after_off": (100 * np.abs(np.expm1(np.array(row["after_log_stiffness"]) - true))).tolist(),
    }


def _table(rows: Sequence[dict[str, Any]], field: str, mean) -> list[str]:
    """By cable, and what either rule gains."""
    table = [["cable", "before", "at random", "fastest", "by information", "best"]]
    cables = sorted({row["cable"] for row in rows})
    for name in [*cables, *(["all"] if len(cables) > 1 else [])]:
        cells = [
            [row[f"before_{field}"], *_choices(row, field).values()] for row in rows if name in (row["cable"], "all")
        ]
        table.append([name, *(f"{mean(value):.2f}" for value in np.mean(cells, axis=0))])
    words = []
    for rule in ("by information", "fastest"):
        gain = np.array([_choices(row, field)[rule] - _choices(row, field)["at random"] for row in rows])
        number, unit = f"{gain.mean():+.2f} ± {_error(gain):.2f}", " in the logarithm" if mean is np.exp else ""
        words.append(f"{rule} {number}{unit}, less in {int((gain < 0).sum())} of {len(gain)} draws")
    ranks = np.array([spearmanr(row["information_nats"], row[f"after_{field}"])[0] for row in rows])
    return [
        *markdown_table(table),
        "",
        f"Compared with random choice (mean ± standard error): {'; '.join(words)}. Rank correlation of the information "
        f"with this over the candidates: {ranks.mean():+.2f} ± {_error(ranks):.2f} (-1 would be perfect).",
    ]


def _error(values: Float[np.ndarray, "K"]) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def _choices(row: dict[str, Any], field: str) -> dict[str, float]:
    """What each way of choosing among the candidates leads to."""
    values = np.array(row[f"after_{field}"])
    return {
        "at random": float(values.mean()),
        "fastest": float(values[np.argmax(row["clamp_speed_m_per_s"])]),
        "by information": float(values[np.argmax(row["information_nats"])]),
        "best": float(values.min()),
    }


if __name__ == "__main__":
    main()
