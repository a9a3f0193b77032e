"""Makes cable logs whose cause is withheld, and commits to their labels by hashes.

python experiments/20_blind_generate.py --plan small --out DIR --labels LABELS.jsonl --hashes SET.jsonl    # five cases
python experiments/20_blind_generate.py --plan stored ...                      # 155 cases, resumable, half an hour
python experiments/20_blind_generate.py ... --family A --executor 2            # in two processes, or tcp://...

Writes `<8 hex>.npz` to --out, a row per case to --labels, and its hash to --hashes. The hashes are published before any
diagnosis runs, the labels after it. Same seed, same logs.
"""

from __future__ import annotations

import argparse
import functools
import os
import pathlib
import time

os.environ.setdefault("NPROC", "4")

from blind.cases import Draft, make_case
from blind.families import FAMILIES
from blind.plan import PLANS, Case
from blind.record import Unreachable
from blind.store import checked_labels, is_done, publish_hashes, read_cases, write_case, write_open_labels
from executors import add_option, executor_of, results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plan", choices=PLANS, default="small")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder of the logs")
    parser.add_argument("--labels", type=pathlib.Path, required=True, help="file of the labels, which stays secret")
    parser.add_argument("--hashes", type=pathlib.Path, required=True, help="file of the set, which gets the hashes")
    parser.add_argument("--family", default="ABCD", help="letters of the families to make now")
    add_option(parser)
    parser.add_argument("--limit", type=int, help="stop after this many cases")
    parser.add_argument("--open-labels", action="store_true", help="also write labels.json next to the logs: not blind")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cases = [case for case in PLANS[options.plan](options.seed) if case.family in options.family]
    mine = {case.index: case for case in cases[: options.limit]}
    todo = [(case,) for case in mine.values() if not is_done(case.name(options.seed), options.out, options.labels)]
    start, made, failed = time.time(), 0, []
    with executor_of(options.executor) as executor:
        for (case,), draft in results(executor, functools.partial(drafted, options.seed), todo):
            if isinstance(draft, str):
                failed.append(case.index)
                print(f"case {case.index}: {draft}", flush=True)
            else:
                write_case(case, draft, options.seed, options.out, options.labels)
                publish_hashes(options.labels, options.hashes)
                made += 1
            # Says nothing of what a case is: the log of a run may be read by those who diagnose.
            done, seconds = len(mine) - len(todo) + made + len(failed), time.time() - start
            line = f"{done}/{len(mine)} of families {options.family}, {seconds:.0f} s, {len(failed)} not possible"
            print(line, flush=True)
            (options.out / "STATUS.txt").write_text(line + "\n")
    total = publish_hashes(options.labels, options.hashes)
    if options.open_labels:
        write_open_labels(options.out, checked_labels(read_cases([options.labels, options.hashes])))
    print(f"{made} cases made, {total} in {options.labels}; not possible: {failed}")


def drafted(seed: int, case: Case) -> Draft | str:
    """A case with its motions, or why it is not possible."""
    try:
        return make_case(case, seed, FAMILIES[case.family]())
    except Unreachable as error:
        return str(error)


if __name__ == "__main__":
    main()
