"""Compares the diagnosis of a case with its label.

Only the verdict's JSON (`cablejax-verdict/1`) is read, so that anything that writes it can be scored. A case without a
verdict stays in every count as a failure.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

SCHEMA = "cablejax-verdict/1"
VERDICTS = ("none", "named", "ambiguous", "named+unknown", "unknown")
TRACE = 0.7
"""Gap over noise below which two descriptions of a log are the same to the eye; see `cases.TRACELESS`."""
KEYPOINTS = 13


@dataclasses.dataclass(frozen=True)
class Scored:
    """One case.

    Attributes:
        name: of its log and its row.
        label: what is true.
        verdict: what was said; None where there is none.
    """

    name: str
    label: dict[str, Any]
    verdict: dict[str, Any] | None

    @property
    def kind(self) -> str:
        return self.label["kind"]

    @property
    def family(self) -> str:
        return self.label["family"]

    @property
    def truth(self) -> list[str]:
        """Names of the effects that are there."""
        return [effect["name"] for effect in self.label["effects"]]

    @property
    def severity(self) -> int:
        return self.label["severity"] or 0

    @property
    def traceless(self) -> bool:
        """Whether even who knows the effect sees nothing of it."""
        return bool(self.label["traceless"])

    @property
    def twins(self) -> set[str]:
        """Other names that describe this log as well as the true one."""
        return {name for name, left in self.label.get("twins", {}).items() if left < TRACE}

    @property
    def said(self) -> str:
        return "missing" if self.verdict is None else self.verdict["verdict"]

    @property
    def named(self) -> list[str]:
        """Names given as the cause, the most probable first."""
        if self.verdict is None:
            return []
        effects = self.verdict.get("effects") or []
        return [e["name"] for e in sorted(effects, key=lambda effect: -(effect.get("probability") or 0.0))]

    @property
    def top(self) -> str | None:
        return self.named[0] if self.named else None

    @property
    def reported(self) -> set[str]:
        """The named effects and everything said to be equivalent to one of them."""
        if self.verdict is None:
            return set()
        if not self.named and self.said == "ambiguous":
            return set().union(*self._groups)
        return set().union(*(self.alike(name) for name in self.named))

    @property
    def _groups(self) -> list[set[str]]:
        return [set(group) for group in (self.verdict or {}).get("equivalent") or []]

    def alike(self, name: str) -> set[str]:
        """A named effect and everything said to be equivalent to it."""
        return {name}.union(*(group for group in self._groups if name in group))

    def is_cause(self, name: str) -> bool:
        """Whether a named effect is there, or one that is said to be equivalent to it."""
        return bool(set(self.truth) & self.alike(name))

    def ranked(self, count: int) -> list[str]:
        """The most probable names of the ranking."""
        ranking = (self.verdict or {}).get("ranking") or []
        return [row["name"] for row in sorted(ranking, key=lambda row: -(row.get("probability") or 0.0))[:count]]

    @property
    def says_unknown(self) -> bool:
        return self.said in ("unknown", "named+unknown")

    def effect(self, name: str) -> dict[str, Any] | None:
        """What was said of a named effect."""
        for effect in (self.verdict or {}).get("effects") or []:
            if effect["name"] == name:
                return effect
        return None


def scored(cases: dict[str, dict[str, Any]], labels: dict[str, dict[str, Any]], field: str = "verdict") -> list[Scored]:
    """Every labelled case with its verdict.

    Args:
        cases: rows by name, see `store.read_cases`.
        labels: by name.
        field: of the rows that has the verdict; a case without it has none.

    Raises:
        ValueError: a field that is no verdict.
    """
    for name in labels:
        verdict = cases[name].get(field)
        if verdict is not None and (verdict.get("schema") != SCHEMA or verdict.get("verdict") not in VERDICTS):
            raise ValueError(
                f"Case {name} has schema {verdict.get('schema')!r} and verdict {verdict.get('verdict')!r} in "
                f"{field!r}, expected {SCHEMA!r} and one of {VERDICTS}."
            )
    return [Scored(name, label, cases[name].get(field)) for name, label in labels.items()]


def place_error(case: Scored, effect: dict[str, Any], length: float = 1.0) -> float | None:
    """Distance between a local effect and where it was said to be, in lengths of the cable; None for other effects.

    Infinite where the name is right and no place was given.
    """
    name, true = effect["name"], effect["parameters"]
    said = case.effect(name)
    if name in ("stiffness_profile", "intrinsic_curvature", "lumped_mass"):
        place = _value(said, "centre_m")
        if place is None:
            place = _middle(said)
        return math.inf if place is None else abs(place - true["centre_m"]) / length
    if name in ("friction_patch", "obstacle"):
        x, y = _value(said, "x_m"), _value(said, "y_m")
        if x is None or y is None:
            return math.inf
        return math.hypot(x - true["x_m"], y - true["y_m"]) / length
    if name in ("gripper_slip", "gripper_rotation_offset", "gripper_compliance"):
        gripper = _value(said, "gripper")
        return math.inf if gripper is None else float(round(gripper) != true["gripper"])
    if name == "keypoint_bias":
        index = _value(said, "index")
        if index is None:
            return math.inf
        found = [round(i) for i in (index if isinstance(index, list) else [index])]
        wanted = true["index"] if isinstance(true["index"], list) else [true["index"]]
        # The worst of: a biased keypoint nobody pointed at, a keypoint pointed at in vain.
        far = [min(abs(i - j) for j in found) for i in wanted] + [min(abs(i - j) for j in wanted) for i in found]
        return max(far) / (KEYPOINTS - 1)
    return None


def coverages(case: Scored) -> list[tuple[str, bool]]:
    """For every parameter of the specification of every effect named rightly: whether its 90 % interval covers."""
    rows = []
    for effect in case.label["effects"]:
        said = case.effect(effect["name"])
        if said is None:
            continue
        for parameter, true in effect["parameters"].items():
            if parameter.startswith("_") or parameter in ("gripper", "index"):
                continue
            interval = ((said.get("parameters") or {}).get(parameter) or {}).get("ci90")
            if not interval or interval[0] is None or interval[1] is None:
                continue
            trues = _as_list(true)
            # one interval, or one of each of several pieces
            pieces = interval if isinstance(interval[0], list | tuple) else [interval]
            for number, (low, high) in _matched(effect["parameters"], said["parameters"], len(trues), pieces):
                value = trues[number]
                if parameter == "direction_rad":  # angles are the same after a turn
                    turn = 2 * math.pi
                    value = low + (value - low) % turn
                    high = low + (high - low) if high - low < turn else low + turn
                rows.append((f"{effect['name']}.{parameter}", low <= value <= high))
    return rows


def _matched(true: dict[str, Any], said: dict[str, Any], count: int, pieces: list[Any]) -> list[tuple[int, Any]]:
    """Numbers of an effect's true pieces and what is said of each: by `index` where there is one, else in order."""
    if "index" not in true or "index" not in said:
        return list(enumerate(pieces))[:count]
    places = _as_list(said["index"]["value"])
    numbers = {index: number for number, index in enumerate(_as_list(true["index"]))}
    return [(numbers[p], piece) for p, piece in zip(places, pieces, strict=True) if p in numbers]


def shrinkage_ratio(case: Scored) -> float | None:
    """Shrinkage of the gap over that which the true effect gives.

    A verdict may bring the true effect's own shrinkage in its simulator (`gap.oracle_shrinkage`); else it is that of
    the simulator which made the log, which leaves the noise alone.
    """
    given = (case.verdict or {}).get("gap") or {}
    shrinkage = given.get("shrinkage")
    if shrinkage is None:
        return None
    oracle = given.get("oracle_shrinkage")
    if oracle is None:
        label = case.label
        floor, before, after = label["noise_mm"], label["gap_rmse_mm_noisy"], label["oracle_after_mm"]
        oracle = 1 - (after**2 - floor**2) / (before**2 - floor**2)
    return shrinkage / oracle if oracle > 0 else None


def _value(said: dict[str, Any] | None, parameter: str) -> Any:
    entry = ((said or {}).get("parameters") or {}).get(parameter)
    return entry.get("value") if isinstance(entry, dict) else entry


def _middle(said: dict[str, Any] | None) -> float | None:
    along = ((said or {}).get("location") or {}).get("along_cable_m")
    return 0.5 * (along[0] + along[1]) if along else None


def _as_list(value: Any) -> list:
    return value if isinstance(value, list) else [value]


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What two verdicts on one log disagree in: the word, the causes, what is equivalent, values out of intervals.

    Args:
        before: whose 90 % intervals count.
        after: of another version of the diagnosis.
    """
    found = []
    if before["verdict"] != after["verdict"]:
        found.append(f"{before['verdict']} -> {after['verdict']}")
    causes, now = ({effect["name"]: effect["parameters"] for effect in v["effects"]} for v in (before, after))
    if set(causes) != set(now):
        found.append(f"named {sorted(causes)} -> {sorted(now)}")
    groups, groups_now = ({tuple(sorted(group)) for group in v["equivalent"] or []} for v in (before, after))
    if groups != groups_now:
        found.append(f"equivalent {sorted(groups - groups_now)} -> {sorted(groups_now - groups)}")
    for name in causes.keys() & now.keys():
        for key in sorted(causes[name].keys() ^ now[name].keys()):
            found.append(f"{name}.{key} {'is not given any more' if key in causes[name] else 'is new'}")
        for key in causes[name].keys() & now[name].keys():
            parameter = causes[name][key]
            value, interval = now[name][key]["value"], parameter["ci90"]
            if interval is None:
                same = value == parameter["value"]
            else:  # one interval, or one for each keypoint
                lower, upper = np.transpose(interval)
                same = bool(np.all((lower <= np.array(value)) & (np.array(value) <= upper)))
            if not same:
                found.append(f"{name}.{key} {parameter['value']} in {interval} -> {value}")
    return found
