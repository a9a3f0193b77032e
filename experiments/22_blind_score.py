"""Scores diagnoses of blind cases against the labels whose hashes were published before.

python experiments/22_blind_score.py SET.jsonl LABELS.jsonl VERDICTS.jsonl --keep SET.jsonl    # once, makes one file
python experiments/22_blind_score.py SET.jsonl --report page.md
python experiments/22_blind_score.py SET.jsonl --replayed VERDICTS.jsonl    # of the same logs, by another version

Checks every label against its published hash, reads verdicts (`cablejax-verdict/1`) and writes a page with the table,
the figures and the list of cases. A case without a verdict counts as a failure.
"""

from __future__ import annotations

import argparse
import pathlib
import shlex
import sys

from blind.measures import leftovers
from blind.score_page import summary, write_page
from blind.store import checked_labels, read_cases, write_cases
from blind.verdicts import differences, scored
from rows import read_rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=pathlib.Path, nargs="+", help="files that together have hashes, labels, verdicts")
    parser.add_argument("--keep", type=pathlib.Path, help="only put the files together, checked, as this one")
    parser.add_argument("--verdict", default="verdict", help="field with the verdicts; verdict_commissioned is another")
    parser.add_argument("--report", type=pathlib.Path, help="page to write, with figures next to it")
    parser.add_argument(
        "--replayed", type=pathlib.Path, help="only print how these verdicts differ from the stored ones"
    )
    parser.add_argument("--family", default="ABCD", help="letters of the families to score; the others are left out")
    parser.add_argument(
        "--leftovers",
        action="store_true",
        help="print what right explanations of single effects leave, for cablejax.diagnose.belief, and nothing else",
    )
    options = parser.parse_args()
    rows = read_cases(options.cases)
    if options.replayed:
        print_differences(rows, read_rows(options.replayed), options.verdict)
        return
    checked = checked_labels(rows)
    if options.keep:
        write_cases(options.keep, {name: rows[name] for name in checked})
        print(f"Written: {len(checked)} cases in {options.keep}")
        return
    labels = {name: label for name, label in checked.items() if label["family"] in options.family}
    cases = scored(rows, labels, options.verdict)
    if options.leftovers:
        print(*(f"{score:.2f}" for score in leftovers(cases)))
        return
    print(summary(cases))
    if options.report:
        write_page(cases, options.report, shlex.join(["python", *sys.argv]))
        print(f"Written: {options.report}")


def print_differences(stored: dict[str, dict], replayed: list[dict], field: str) -> None:
    """A line for every log whose replayed verdict differs from the stored one, and their count."""
    found = {
        row["name"]: differences(stored[row["name"]][field], row[field]) if field in row else ["refused"]
        for row in replayed
    }
    changed = {name: lines for name, lines in found.items() if lines}
    for name, lines in changed.items():
        print(name, "; ".join(lines))
    print(f"{len(changed)} of {len(found)} replayed logs differ in verdict, causes, equivalents, or a value's interval")


if __name__ == "__main__":
    main()
