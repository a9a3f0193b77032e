"""The numbers of the blind check, from cases and verdicts."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable

import numpy as np
from scipy.stats import binomtest

from cablejax.diagnose.belief import Calibration, leftover_score

from .verdicts import Scored, coverages, place_error, shrinkage_ratio

SEVERE = 4


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        measure: its name.
        value: as text.
        wanted, goal: as text.
        reached: whether it is what this check must reach; None where nothing is asked.
    """

    measure: str
    value: str
    wanted: str = ""
    goal: str = ""
    reached: bool | None = None


def share(hits: Iterable[bool]) -> tuple[int, int, float]:
    """Hits, number and rate (nan of nothing)."""
    values = [bool(hit) for hit in hits]
    return sum(values), len(values), float(np.mean(values)) if values else float("nan")


def rate_interval(hits: int, count: int) -> tuple[float, float]:
    """Exact (Clopper-Pearson) 90 % interval of a rate; each side alone holds with 95 %."""
    interval = binomtest(hits, count).proportion_ci(0.9)
    return float(interval.low), float(interval.high)


def text(hits: Iterable[bool]) -> str:
    """A rate with its counts and exact 90 % interval."""
    found, count, rate = share(hits)
    if count == 0:
        return "no case"
    low, high = rate_interval(found, count)
    return f"{100 * rate:.0f} % ({found}/{count}; {100 * low:.0f}-{100 * high:.0f} %)"


def severe_singles(cases: list[Scored]) -> list[Scored]:
    """Single effects at a severity of four or more that leave a trace."""
    return [c for c in cases if c.kind == "single" and c.severity >= SEVERE and not c.traceless]


def table(cases: list[Scored]) -> list[Row]:
    """Every row that the check asks for."""
    singles = severe_singles(cases)
    alone = [c for c in singles if not c.twins]
    nones = [c for c in cases if c.kind == "none"]
    pairs = [c for c in cases if c.kind == "pair" and c.severity >= SEVERE and not c.traceless]
    unknowns = [c for c in cases if c.kind == "unknown" and c.severity >= SEVERE and not c.traceless]
    rows = []

    def add(measure: str, hits: list[bool], wanted: str, goal: str, at_least: float | None = None) -> float:
        rate = share(hits)[2]
        reached = None if at_least is None or not hits else rate >= at_least
        rows.append(Row(measure, text(hits), wanted, goal, reached))
        return rate

    named = len({c.truth[0] for c in alone})
    add(
        f"top-1 on distinguishable single effects ({named} kinds)",
        [c.top == c.truth[0] for c in alone],
        ">= 80 %",
        "92 %",
        0.8,
    )
    add("top-1, effects with a twin included", [c.top == c.truth[0] for c in singles], "", "")
    add("top-1, a twin counts as right", [c.top in {c.truth[0], *c.twins} for c in singles], "", "")
    add("top-3 of the ranking", [c.truth[0] in c.ranked(3) for c in singles], "", "")
    coverage = [c.truth[0] in c.reported for c in singles]
    sizes = [len(c.reported) for c in singles if c.reported]
    size = float(np.mean(sizes)) if sizes else float("nan")
    rate = share(coverage)[2]
    rows.append(
        Row(
            "true effect inside the reported set",
            f"{text(coverage)}, mean size {size:.2f}",
            ">= 92 %, size <= 2",
            "98 %, 1.5",
            bool(rate >= 0.92 and size <= 2) if coverage else None,
        )
    )
    alarms = [c.said not in ("none", "missing") for c in nones]
    found, count, rate = share(alarms)
    bound = f", at most {100 * float(rate_interval(found, count)[1]):.0f} % with 95 %" if count else ""
    rows.append(
        Row(
            "false alarms on no-effect cases",
            text(alarms) + bound,
            "<= 10 %",
            "<= 1 in 120",
            rate <= 0.1 if count else None,
        )
    )
    known = [c for c in cases if c.kind in ("none", "single", "pair") and (c.kind == "none" or c.severity >= SEVERE)]
    false_unknown = share(c.says_unknown for c in known)[2]
    recall = [c.says_unknown for c in unknowns]
    rate = share(recall)[2]
    rows.append(
        Row(
            "unknown recall at false unknown",
            f"{text(recall)} at {text([c.says_unknown for c in known])}",
            ">= 60 % at <= 10 %",
            "80 % at 5 %",
            bool(rate >= 0.6 and false_unknown <= 0.1) if recall else None,
        )
    )
    add("unknown recall, no name beside it", [c.said == "unknown" for c in unknowns], "", "")
    partly = [c.is_cause(name) for c in cases if c.said == "named+unknown" for name in c.named]
    add("effects named beside an unknown cause that are there, or a look-alike", partly, "", "")
    add("both of a pair", [set(c.truth) <= set(c.named) for c in pairs], ">= 50 %", "75 %", 0.5)
    add("both of a pair, equivalents counted", [set(c.truth) <= c.reported for c in pairs], "", "")
    add("at least one of a pair", [bool(set(c.truth) & set(c.named)) for c in pairs], ">= 90 %", "97 %", 0.9)
    ratios = [shrinkage_ratio(c) for c in singles + pairs]
    given = [ratio for ratio in ratios if ratio is not None]
    # A verdict without a shrinkage has shrunk nothing.
    median = float(np.median([0.0 if ratio is None else ratio for ratio in ratios])) if ratios else float("nan")
    rows.append(
        Row(
            "shrinkage over the true effect's own",
            f"median {median:.2f} of {len(ratios)} ({len(ratios) - len(given)} not given)",
            "median >= 0.85",
            "0.95",
            median >= 0.85 if ratios else None,
        )
    )
    found_places = [(place_error(c, e), e["name"] in c.named) for c in singles for e in c.label["effects"]]
    local = [(place, known) for place, known in found_places if place is not None]
    places = [place for place, known in local if known]
    add("place of local effects within 10 %, of those named", [p <= 0.1 for p in places], ">= 80 %", "5 %, 90 %", 0.8)
    add("place within 5 %, of those named", [p <= 0.05 for p in places], "", "")
    add("place within 10 %, of all local effects", [known and place <= 0.1 for place, known in local], "", "")
    covered = [hit for c in singles + pairs for _, hit in coverages(c)]
    rate = share(covered)[2]
    rows.append(
        Row("90 % intervals that cover", text(covered), "75-97 %", "85-95 %", 0.75 <= rate <= 0.97 if covered else None)
    )
    seconds = [c.verdict["seconds"] for c in cases if c.verdict and c.verdict.get("seconds") is not None]
    if seconds:
        rows.append(
            Row(
                "time for a log",
                f"median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s",
                "<= 180 s",
                "60 s",
                bool(np.median(seconds) <= 180),
            )
        )
    return rows


def baselines(cases: list[Scored]) -> list[tuple[str, str, str, str]]:
    """Name of a baseline, top-1 on distinguishable singles, at least one of a pair, names given without an effect."""
    names = sorted({name for c in cases if c.verdict for name in (c.verdict.get("baselines") or {})})
    alone = [c for c in severe_singles(cases) if not c.twins]
    pairs = [c for c in cases if c.kind == "pair" and c.severity >= SEVERE]
    nones = [c for c in cases if c.kind == "none"]

    def row(label: str, said: Callable[[Scored], str | None]) -> tuple[str, str, str, str]:
        return (
            label,
            text(said(c) == c.truth[0] for c in alone),
            text(said(c) in c.truth for c in pairs),
            text(said(c) not in (None, "none") for c in nones),
        )

    rows = [row("the diagnosis", lambda c: c.top)]
    for name in names:
        rows.append(row(name, lambda c, name=name: ((c.verdict or {}).get("baselines") or {}).get(name)))
    return rows


def outcome(case: Scored) -> str:
    """Column of the confusion matrix: the first name, or what was said instead."""
    return case.top if case.top else case.said


def reliability(cases: list[Scored], edges=(0.0, 0.5, 0.7, 0.8, 0.9, 0.97, 1.0001)) -> list[tuple[float, float, int]]:
    """Mean top probability, share of right names and number, by bins of that probability; empty bins left out."""
    said = []
    for case in cases:
        effect = case.effect(case.top) if case.top else None
        if effect and effect.get("probability") is not None:
            said.append((effect["probability"], case.top in case.truth))
    rows = []
    for low, high in itertools.pairwise(edges):
        inside = [(p, hit) for p, hit in said if low <= p < high]
        if inside:
            rows.append(
                (float(np.mean([p for p, _ in inside])), float(np.mean([hit for _, hit in inside])), len(inside))
            )
    return rows


def leftovers(cases: list[Scored]) -> list[float]:
    """Scores of `cablejax.diagnose.belief`, sorted: of single effects of the library that the reported set has.

    Effects of the arms show in the encoders and are left out.
    """
    scores, calibration = [], Calibration()
    for case in cases:
        if case.kind != "single" or case.verdict is None or case.truth[0] not in case.reported:
            continue
        if case.truth[0].startswith("actuation") or not case.named:
            continue
        left = {ranked["name"]: ranked["leftover_mm"] for ranked in case.verdict["ranking"]}
        # what the nominal cable leaves stands beside every effect that was not fitted
        rest, gap, noise = left[case.truth[0]], max(left.values()), case.verdict["gap"]["noise_floor_mm"]
        scores.append(leftover_score(1e-3 * rest, 1e-3 * gap, 1e-3 * noise, calibration))
    return sorted(scores)
