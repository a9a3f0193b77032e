"""Counts how often the diagnosis calls recordings of one set-up, and of two, contradictory.

    python experiments/26_same_or_not.py --logs FOLDER --rows ROWS.jsonl    # a minute a pair; resumable
    python experiments/26_same_or_not.py --rows ROWS.jsonl --report docs/results/same_or_not.md

Every log is divided into two recordings, its odd and its even episodes. Two recordings of one log agree, and a
contradiction is a false alarm. The first recording of one log and the second of the next, in the order of their names,
are of two set-ups that differ by their effects. Logs with the same effects are not paired, nor are logs that state
different cables, since such recordings are refused.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import pathlib
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("NPROC", "4")

import numpy as np

from cablejax.diagnose import diagnose
from cablejax.diagnose.rounds import UNLIKELY
from cablejax.gaplog import read_gap_log
from cablejax.gaplog_check import GapLogError
from cablejax.gaplog_join import chosen, joined
from cablejax.types import GapLog
from executors import add_option, executor_of
from pages import markdown_table, page_of_results, publish
from rows import Rows, made_on


def half(log: GapLog, first: int) -> GapLog:
    """Every other episode of a log, from number `first` on."""
    return chosen(log, range(first, len(log.episode_length), 2))


def examine(folder: pathlib.Path, first: str, second: str) -> dict[str, Any]:
    """The row of a pair of recordings."""
    one, other = (half(read_gap_log(folder / f"{name}.npz"), k) for k, name in enumerate((first, second)))
    found = diagnose(joined([one, other], names=("one", "other")))
    rounds = found.rounds
    return {
        "verdict": found.verdict,
        "effects": [effect.name for effect in found.effects],
        "chance": None if rounds is None else rounds.contradiction,
        "seconds": found.seconds,
    }


def may_be_joined(folder: pathlib.Path, one: str, other: str) -> bool:
    """Whether two logs state one set-up."""
    try:
        joined([read_gap_log(folder / f"{name}.npz") for name in (one, other)], names=(one, other))
    except GapLogError:
        return False
    return True


def truth_of(folder: pathlib.Path) -> dict[str, str]:
    """The effects of labelled logs by name, as text."""
    labels = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
    return {
        name: json.dumps([(effect["name"], effect["parameters"]) for effect in label["effects"]], sort_keys=True)
        for name, label in labels.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=pathlib.Path, help="folder of gap logs with labels.json")
    parser.add_argument("--rows", type=pathlib.Path, required=True)
    parser.add_argument("--report", type=pathlib.Path, help="write the page of the finished rows, and run nothing")
    add_option(parser)
    options = parser.parse_args()
    rows = Rows(options.rows, ("first", "second"))
    if options.report is not None:
        publish(page(rows.read(), made_on(options.rows)), options.report)
        return
    if options.logs is None:
        parser.error("--logs is missing: the folder of gap logs.")
    truth = truth_of(options.logs)
    names = sorted(name for name in truth if (options.logs / f"{name}.npz").exists())
    pairs = [(name, name) for name in names]
    pairs += [
        (one, other)
        for one, other in zip(names, names[1:] + names[:1], strict=True)
        if truth[one] != truth[other] and may_be_joined(options.logs, one, other)
    ]
    make = functools.partial(examine, options.logs.absolute())
    with executor_of(options.executor) as executor:
        rows.run(rows.missing(pairs), make, executor=executor)


def page(rows: Sequence[dict[str, Any]], made: str) -> str:
    """The page of all rows."""
    table = [("recordings", "pairs", "contradict one another", "no effect to compare", "median seconds")]
    for title, same in (("of one set-up", True), ("of two set-ups", False)):
        of = [row for row in rows if (row["first"] == row["second"]) == same]
        judged = [row for row in of if row["chance"] is not None]
        found = sum(row["chance"] < UNLIKELY for row in judged)
        seconds = f"{np.median([row['seconds'] for row in of]):.0f}" if of else ""
        table.append((title, f"{len(of)}", f"{found} of {len(judged)}", f"{len(of) - len(judged)}", seconds))
    missed = [row for row in rows if row["first"] != row["second"] and (row["chance"] or 0.0) >= UNLIKELY]
    lines = [
        "Every labelled log of another program is divided into its odd and even episodes, which agree. The first half "
        "of each log is also joined with the second half of the next, from another set-up. A p-value below "
        f"{UNLIKELY:g} counts as a contradiction.",
        "",
        *markdown_table(table),
        "",
        "Undetected pairs of set-ups, by their joint verdict: "
        + ("; ".join(f"{row['verdict']} {' + '.join(row['effects'])}".strip() for row in missed) or "none")
        + ".",
    ]
    made_by = "`python experiments/26_same_or_not.py --rows ROWS.jsonl --report docs/results/same_or_not.md`"
    return page_of_results("Do recordings agree?", made_by, lines, made_on=made)


if __name__ == "__main__":
    main()
