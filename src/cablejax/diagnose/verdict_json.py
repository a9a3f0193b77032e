"""The verdict in the format `cablejax-verdict/1`: strict JSON, for other programs to read."""

from __future__ import annotations

import dataclasses
import math
import os
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from cablejax.cable_file import cable_of_log, cable_to_fields
from cablejax.diagnose.diagnosis import (
    PLACES,
    CableDiagnosis,
    Diagnosis,
    EffectValues,
    Gap,
    NamedEffect,
    NextMotion,
    ParameterEstimate,
    Ranked,
    UnderLaw,
)
from cablejax.effects.verdicts import VERDICT_SCHEMA, read_verdict_json
from cablejax.limits import LIMITS, shown
from cablejax.text_file import write_json

if TYPE_CHECKING:
    from cablejax.diagnose.where import Where


def verdict_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The verdict as a JSON object; null where a number is not finite, was never observed or not computed.

    Where the verdict is "unknown" nothing was added, and nothing shrinks; `gap.best_shrinkage` is that of the best
    explanation all the same. `ci90` is null for a choice, such as a gripper, and a list where the value is one. All
    `_mm` are null where observations are not in metres; `gap` has the sizes in their own unit too.

    In addition to the fields of the format it has `cable` (the keys of a cable file: as the log states it, or with the
    length that `quantities` has), `dimension` (2 on a table, 3 in space, else null), `place_m` (where the grippers are
    on average, in the world of the effects' places; null in space), `sentence`, `baselines`, `leftover_p`, `caveats`,
    `seconds`, `quantities` (by name, like an effect's parameters), `posterior` (fields of `EffectValues`), `under_laws`
    (fields of `UnderLaw`), `undecided` and `next_motion_worth`: fields of `NextMotion`, those in nats with `_nats`, and
    whether no motion that was tried separates the explanations; of several recordings `rounds`, the fields of `Round`,
    and `rounds_contradict`. `next_motion` is recommended only where that is false. `gap` has also `unit`,
    `before_rmse`, `noise_floor`, `after_rmse`, `horizons`, `split`, `ahead_mm` and `best_shrinkage`, an effect also
    `alike`, `ranking` also `leftover_mm` and `outcome`, and `where` also `sentences`, `per_horizon_mm`, `frames` and
    `along_share`.
    """
    gap, rounds = diagnosis.gap, getattr(diagnosis, "rounds", None)
    return _plain(
        {
            "schema": VERDICT_SCHEMA,
            "cable": _cable(diagnosis),
            "dimension": diagnosis.log.keypoints.shape[-1] if isinstance(diagnosis, CableDiagnosis) else None,
            "place_m": _place(diagnosis),
            "verdict": diagnosis.verdict,
            "sentence": diagnosis.sentence,
            "effects": [_effect(effect) for effect in diagnosis.effects],
            "quantities": {name: dataclasses.asdict(one) for name, one in diagnosis.quantities.items()},
            "equivalent": diagnosis.equivalent,
            "posterior": [[dataclasses.asdict(one) for one in draw] for draw in diagnosis.posterior],
            "under_laws": [
                dataclasses.asdict(law) | {"effects": [_effect(effect) for effect in law.effects]}
                for law in diagnosis.under_laws
            ],
            "baselines": diagnosis.baselines,
            "ranking": [
                dataclasses.asdict(one) | {"leftover_mm": one.leftover_mm if gap.unit == "m" else None}
                for one in diagnosis.ranking
            ],
            "undecided": diagnosis.undecided,
            "leftover_p": diagnosis.leftover_p,
            # what no effect was named for has not shrunk, however much an explanation that was not believed takes away
            "gap": _gap(gap, blamed=diagnosis.verdict != "unknown"),
            "where": None if diagnosis.where is None else _where(diagnosis.where),
            "next_motion": None if diagnosis.next_motion is None else diagnosis.next_motion.motion,
            "next_motion_worth": None if diagnosis.next_motion is None else _worth(diagnosis.next_motion),
            "rounds": None if rounds is None else [dataclasses.asdict(one) for one in rounds.rounds],
            "rounds_contradict": None if rounds is None else rounds.contradictory,
            "caveats": diagnosis.caveats,
            "seconds": diagnosis.seconds,
        }
    )


def _cable(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """The cable to which the effects would be added; None of a simulator of one's own."""
    if not isinstance(diagnosis, CableDiagnosis):
        return None
    try:
        return cable_to_fields(cable_of_log(diagnosis.log))
    except ValueError:  # a rod that no planar simulator can take
        return None


def _place(diagnosis: Diagnosis) -> list[float] | None:
    """Of the grippers on a table [m]; None in space, and of a simulator of one's own."""
    if not isinstance(diagnosis, CableDiagnosis) or diagnosis.log.in_space:
        return None
    log = diagnosis.log
    return (np.round(log.gripper_pose[log.valid][..., :2].mean(axis=(0, 1), dtype=float), 2) + 0.0).tolist()


def write_verdict(path: str | os.PathLike[str], diagnosis: Diagnosis) -> pathlib.Path:
    """Writes the verdict, whole or not at all, over what was there, and returns its path."""
    (path := pathlib.Path(path)).parent.mkdir(parents=True, exist_ok=True)
    write_json(path, verdict_json(diagnosis))
    return path


def read_verdict(path: str | os.PathLike[str]) -> Diagnosis:
    """The diagnosis that a verdict's file describes: its effects, ranking and gap; without `where` and `next_motion`.

    Raises:
        ValueError: the file is no verdict, or a damaged one.
    """
    verdict = read_verdict_json(path)
    try:
        gap = verdict["gap"]
        return Diagnosis(
            verdict=verdict["verdict"],
            sentence=str(verdict["sentence"]),
            effects=tuple(_effect_of(effect) for effect in verdict["effects"]),
            equivalent=tuple(tuple(map(str, group)) for group in verdict["equivalent"]),
            ranking=tuple(
                Ranked(
                    str(r["name"]),
                    _chance(r["probability"]),
                    _size(r["held_out_shrinkage"]),
                    _size(r["leftover_mm"]),
                    r.get("outcome"),
                )
                for r in verdict["ranking"]
            ),
            undecided=verdict.get("undecided") is True,
            leftover_p=_chance(verdict["leftover_p"]),
            gap=Gap(
                horizon_s=float(gap["horizon_s"]),
                before_rmse_mm=_size(gap["before_rmse"], 1e3),
                after_rmse_mm=_size(gap["after_rmse"], 1e3),
                noise_floor_mm=_size(gap["noise_floor"], 1e3),
                shrinkage=_number(gap["shrinkage"]),
                shrinkage_ci90=_pair(gap["shrinkage_ci90"]),
                ahead_mm=gap["ahead_mm"],
                horizons_mm={
                    h["horizon_s"]: (_size(h["before_rmse_mm"]), _size(h["after_rmse_mm"])) for h in gap["horizons"]
                },
                held_out_episodes=tuple(gap["held_out_episodes"]),
                split=dict(gap["split"]),
                unit=str(gap["unit"]),
            ),
            where=None,
            baselines=dict(verdict["baselines"]),
            caveats=tuple(map(str, verdict["caveats"])),
            seconds=float(verdict["seconds"]),
            posterior=tuple(
                tuple(EffectValues(str(one["name"]), dict(one["parameters"])) for one in draw)
                for draw in verdict.get("posterior", ())
            ),
            under_laws=tuple(
                UnderLaw(
                    str(law["assumes"]),
                    float(_chance(law["probability"])),
                    law["verdict"],
                    tuple(_effect_of(effect) for effect in law["effects"]),
                    tuple(tuple(map(str, group)) for group in law["equivalent"]),
                )
                for law in verdict.get("under_laws", ())
            ),
            quantities={str(name): _estimate_of(one) for name, one in verdict.get("quantities", {}).items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} is a damaged verdict ({reason}). Diagnose the log again.") from error


def _effect_of(effect: Mapping[str, Any]) -> NamedEffect:
    place = effect["location"]
    location = {name: (_number if name == "time_s" else _pair)(place[name]) for name in PLACES}
    estimates = {str(name): _estimate_of(estimate) for name, estimate in effect["parameters"].items()}
    alike = {str(name): float(_chance(one)) for name, one in effect.get("alike", {}).items()}
    return NamedEffect(str(effect["name"]), _chance(effect["probability"]), estimates, location, alike)


def _estimate_of(estimate: Mapping[str, Any]) -> ParameterEstimate:
    value, ci90, unit = estimate["value"], estimate["ci90"], str(estimate["unit"])
    if not isinstance(value, list):
        return ParameterEstimate(_number(value), _pair(ci90), unit)
    intervals = None if ci90 is None else [interval for interval in map(_pair, ci90) if interval is not None]
    if intervals is not None and len(intervals) != len(value):
        raise ValueError(f"{len(value)} values have {len(intervals)} intervals")
    return ParameterEstimate([_number(entry) for entry in value], intervals, unit)


def _number(value: Any) -> Any:
    """The same value if it is a sensible number, or None where it is null. Raises TypeError otherwise."""
    if value is not None and value not in LIMITS["finite"]:
        raise TypeError(f"{shown(value)} is not a number that a diagnosis can have")
    return value


def _chance(value: Any) -> Any:
    """The same value if it is a probability or null. Raises TypeError otherwise."""
    if value is not None and value not in LIMITS["probability"]:
        raise TypeError(f"{shown(value)} is not a probability")
    return value


def _pair(value: Any) -> tuple[float, float] | None:
    """Two numbers, or None. Raises TypeError or ValueError otherwise."""
    if value is None:
        return None
    first, second = value
    return _size(first), _size(second)


def _size(value: float | None, scale: float = 1.0) -> float:
    return math.nan if _number(value) is None else scale * float(value)  # pyright: ignore[reportArgumentType]


def _effect(effect: NamedEffect) -> dict[str, Any]:
    return dataclasses.asdict(effect) | {"location": {place: effect.location.get(place) for place in PLACES}}


def _gap(gap: Gap, *, blamed: bool) -> dict[str, Any]:
    metres = gap.unit == "m"
    if not blamed:  # what explains best is not added to the simulator
        unexplained = sum(gap.split[part] or 0.0 for part in ("named", "learnable", "unexplained"))
        gap = dataclasses.replace(
            gap,
            after_rmse_mm=gap.before_rmse_mm,
            horizons_mm={seconds: (before, before) for seconds, (before, _) in gap.horizons_mm.items()},
            ahead_mm=gap.ahead_mm and gap.ahead_mm | {"named": gap.ahead_mm["nominal"]},
            split=gap.split | {"named": 0.0, "learnable": None, "unexplained": unexplained},
        )
    sizes = {"before_rmse": gap.before_rmse_mm, "noise_floor": gap.noise_floor_mm, "after_rmse": gap.after_rmse_mm}
    return {
        "horizon_s": gap.horizon_s,
        **{f"{name}_mm": size if metres else None for name, size in sizes.items()},
        "unit": gap.unit,
        **{name: 1e-3 * size for name, size in sizes.items()},
        "shrinkage": gap.shrinkage if blamed or gap.shrinkage is None else 0.0,
        "shrinkage_ci90": gap.shrinkage_ci90 if blamed else None,
        "best_shrinkage": gap.shrinkage,
        "held_out_episodes": gap.held_out_episodes,
        "ahead_mm": gap.ahead_mm,
        "horizons": [
            {"horizon_s": seconds, "before_rmse_mm": b if metres else None, "after_rmse_mm": a if metres else None}
            for seconds, (b, a) in sorted(gap.horizons_mm.items())
        ],
        "split": gap.split,
    }


def _worth(following: NextMotion) -> dict[str, Any]:
    return {
        "separates": following.separates,
        "information_nats": following.information,
        "doubt_nats": following.doubt,
        "certainty": following.certainty,
        "inseparable": following.inseparable,
        "alternatives_nats": following.alternatives,
        "search_ended": following.ended,
    }


def _where(where: Where) -> dict[str, Any]:
    return {
        "along_cable_mm": where.along_cable_mm,
        "per_episode_mm": where.per_episode_mm,
        "regimes": where.regimes,
        "per_horizon_mm": [{"horizon_s": end, "gap_mm": size} for end, size in sorted(where.horizons_mm.items())],
        "frames": where.frames,
        "along_share": where.along_share,
        "sentences": where.sentences,
    }


def _plain(value: Any) -> Any:
    """The same with Python's own types only; numbers to six digits, and None for those that are not finite."""
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return float(f"{number:.6g}") if math.isfinite(number) else None
    return value
