"""Scores diagnoses of blind cases against the labels that were locked before.

python experiments/22_blind_score.py VERDICT_DIR LABELS_DIR --hashes HASHES.json --report page.md

Checks every label against its published hash, reads `<case>.json` verdicts (`cablejax-verdict/1`) and writes a page
with the table, the figures and the list of cases. A case without a verdict counts as a failure.
"""

from __future__ import annotations

import argparse
import pathlib
import shlex
import sys

from blind.measures import leftovers
from blind.score_page import summary, write_page
from blind.store import read_labels
from blind.verdicts import read_verdicts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verdicts", type=pathlib.Path, help="folder of the verdicts")
    parser.add_argument("labels", type=pathlib.Path, help="folder of hashes.json and locked/")
    parser.add_argument("--report", type=pathlib.Path, help="page to write, with figures beside it")
    parser.add_argument("--family", default="ABC", help="letters of the families to score; the others are left out")
    parser.add_argument(
        "--hashes",
        type=pathlib.Path,
        nargs="+",
        help="files of hashes published before; default: hashes.json of LABELS_DIR",
    )
    parser.add_argument(
        "--leftovers",
        action="store_true",
        help="print what right explanations of single effects leave, for cablejax.diagnose.conformal, and nothing else",
    )
    options = parser.parse_args()
    checked = read_labels(options.labels, options.hashes)
    labels = {name: label for name, label in checked.items() if label["family"] in options.family}
    cases = read_verdicts(options.verdicts, labels)
    if options.leftovers:
        print(*(f"{score:.2f}" for score in leftovers(cases)))
        return
    print(summary(cases))
    if options.report:
        write_page(cases, options.report, shlex.join(["python", *sys.argv]))
        print(f"Written: {options.report}")


if __name__ == "__main__":
    main()
