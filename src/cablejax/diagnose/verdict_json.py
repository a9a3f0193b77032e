"""The verdict in the format `cablejax-verdict/1`: strict JSON, for other programs to read."""

from __future__ import annotations

import json
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from cablejax.diagnose.diagnosis import Findings, NamedEffect
from cablejax.whole_file import whole_file

SCHEMA = "cablejax-verdict/1"
_PLACES = ("along_cable_m", "time_s", "table_m")


def verdict_json(findings: Findings) -> dict[str, Any]:
    """The verdict as a JSON object; what is not a finite number, was never observed, or was not computed, is null.

    Where the verdict is "unknown" nothing was added, and nothing shrinks; `gap.best_shrinkage` is that of the best
    explanation all the same. `ci90` is null for a choice, such as a gripper, and a list where the value is one.

    Beside the fields of the format it has `sentence`, `baselines`, `leftover_p`, `caveats` and `seconds`; `gap` has
    also `horizons`, `split`, `ahead_mm` and `best_shrinkage`, `ranking` also `leftover_mm`, and `where` also
    `sentences`, `per_horizon_mm` and `frames`.
    """
    gap, where = findings.gap, findings.where
    # what no effect was named for has not shrunk, however much an explanation that was not believed takes away
    blamed = findings.verdict != "unknown"
    seen = np.isfinite(where.heat)
    return _plain(
        {
            "schema": SCHEMA,
            "verdict": findings.verdict,
            "sentence": findings.sentence,
            "effects": [_effect(effect) for effect in findings.effects],
            "equivalent": findings.equivalent,
            "baselines": findings.baselines,
            "ranking": [
                {
                    "name": ranked.name,
                    "probability": ranked.probability,
                    "held_out_shrinkage": ranked.held_out_shrinkage,
                    "leftover_mm": ranked.leftover_mm,
                }
                for ranked in findings.ranking
            ],
            "leftover_p": findings.leftover_p,
            "gap": {
                "horizon_s": gap.horizon_s,
                "before_rmse_mm": gap.before_rmse_mm,
                "noise_floor_mm": gap.noise_floor_mm,
                "after_rmse_mm": gap.after_rmse_mm if blamed else gap.before_rmse_mm,
                "shrinkage": gap.shrinkage if blamed or gap.shrinkage is None else 0.0,
                "shrinkage_ci90": gap.shrinkage_ci90 if blamed else None,
                "best_shrinkage": gap.shrinkage,
                "held_out_episodes": gap.held_out_episodes,
                "ahead_mm": gap.ahead_mm,
                "horizons": [
                    {"horizon_s": seconds, "before_rmse_mm": before, "after_rmse_mm": after}
                    for seconds, (before, after) in sorted(gap.horizons_mm.items())
                ],
                "split": gap.split,
            },
            "where": {
                "along_cable_mm": np.where(seen.any(axis=(0, 1)), where.along_cable_mm, np.nan),
                "per_episode_mm": np.where(seen.any(axis=(1, 2)), where.per_episode_mm, np.nan),
                "regimes": where.regimes,
                "per_horizon_mm": [
                    {"horizon_s": seconds, "gap_mm": size} for seconds, size in sorted(where.horizons_mm.items())
                ],
                "frames": where.frames,
                "sentences": where.sentences,
            },
            "next_motion": None if findings.next_motion is None else findings.next_motion.motion,
            "caveats": findings.caveats,
            "seconds": findings.seconds,
        }
    )


def write_verdict(path: str | os.PathLike[str], findings: Findings) -> pathlib.Path:
    """Writes the verdict, whole or not at all, over what was there, and returns its path."""
    path = pathlib.Path(path)
    text = json.dumps(verdict_json(findings), indent=1, allow_nan=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as stream:
        stream.write(text.encode())
    return path


def _effect(effect: NamedEffect) -> dict[str, Any]:
    return {
        "name": effect.name,
        "probability": effect.probability,
        "parameters": {
            name: {"value": estimate.value, "ci90": estimate.ci90, "unit": estimate.unit}
            for name, estimate in effect.parameters.items()
        },
        "location": {place: effect.location.get(place) for place in _PLACES},
    }


def _plain(value: Any) -> Any:
    """The same with Python's own types only; numbers to six digits, and None for those that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
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
