"""Adds the arms' effects, estimated from the encoders, to the verdict on the cable."""

from __future__ import annotations

import dataclasses
import operator
from typing import get_args

import numpy as np
from scipy.special import softmax

from cablejax.diagnose.actuation import NEGLIGIBLE, Actuation
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.conclude import Conclusion
from cablejax.diagnose.diagnosis import PLACES, EffectValues, NamedEffect, Ranked, Verdict
from cablejax.diagnose.evidence import share_of_motion, student_log_likelihoods
from cablejax.diagnose.posterior import POSTERIOR, QUANTILE
from cablejax.effects.given import EFFECTS


def negligible(calibration: Calibration, length: float) -> float:
    """Deviation of the arms that counts as none [m]. With a cable shorter than 1 m arms err by no less."""
    return calibration.smallest_gap(0.0) / min(length, 1.0)


def with_arms(conclusion: Conclusion, arms: Actuation, calibration: Calibration, length: float = 1.0) -> Conclusion:
    """Adds the arms' effects to the verdict on a cable of this length [m]."""
    if not arms.deviates:
        return conclusion
    scores = _scores(arms, calibration)
    of_set = dict(zip(scores, softmax(list(scores.values())).tolist(), strict=True))
    named = tuple(
        NamedEffect(
            name=name,
            probability=sum(chance for effects, chance in of_set.items() if name in effects),
            parameters=parameters,
            location=dict.fromkeys(PLACES),
        )
        for name, parameters in arms.effects.items()
    )
    # or none of them
    chances = softmax([scores[()], *(scores[name,] for name in arms.alone)])[1:]
    ranked = [
        Ranked(name, float(chance), float(np.clip(1 - (unseen / arms.deviation) ** 2, -1.0, 1.0)), 1e3 * left)
        for chance, (name, (left, unseen)) in zip(chances, arms.alone.items(), strict=True)
    ]
    changed: dict[Verdict, Verdict] = {}
    if named and arms.explained(negligible(calibration, length)):
        changed = {"none": "named", "unknown": "named+unknown"}
    elif named:
        changed = dict.fromkeys(get_args(Verdict), "named+unknown")
    elif arms.strays(negligible(calibration, length)):
        changed = {"none": "unknown", "named": "named+unknown", "ambiguous": "named+unknown"}
    share = 1 - (arms.leftover / arms.deviation) ** 2
    of_cable = conclusion.posterior or ((),) * POSTERIOR
    return dataclasses.replace(
        conclusion,
        verdict=changed.get(conclusion.verdict, conclusion.verdict),
        effects=(*named, *conclusion.effects),
        posterior=tuple(map(operator.add, _drawn(arms, len(of_cable)), of_cable)) if named else conclusion.posterior,
        ranking=tuple(sorted([*ranked, *conclusion.ranking], key=lambda r: -(r.probability or 0.0))),
        explained=share if conclusion.verdict == "none" else conclusion.explained,
        undecided=conclusion.undecided and not named,
    )


def _drawn(arms: Actuation, count: int) -> list[tuple[EffectValues, ...]]:
    """The arms' effects, with values as uncertain as they are; those of one effect are off together."""

    def value(name: str, key: str, share: float) -> float:
        """So many halves of its interval away from the estimate."""
        one = arms.effects[name][key]
        low, high = one.ci90  # pyright: ignore[reportGeneralTypeIssues]
        (bounds,) = (p for p in EFFECTS[name].parameters if p.name == key)
        side = high - one.value if share > 0 else one.value - low
        return float(np.clip(one.value + share * side, bounds.low, bounds.high))

    def values(name: str, share: float) -> EffectValues:
        drawn = {key: value(name, key, share) for key in arms.effects[name]}
        if "delay_s" in drawn:  # a part of the whole lag, which is known better
            drawn["delay_s"] = min(drawn["delay_s"], drawn["time_s"])
        return EffectValues(name, drawn)

    shares = np.random.default_rng(0).standard_normal((count, len(arms.effects))) / QUANTILE
    return [
        tuple(values(name, share) for name, share in zip(arms.effects, row.tolist(), strict=True)) for row in shares
    ]


def _scores(arms: Actuation, calibration: Calibration) -> dict[tuple[str, ...], float]:
    """Logarithm of the probability of every set of effects of the arms, up to a constant.

    By the rule of `belief`: likelihoods of held-out motions, tempered for errors of the arms' laws, and a cost for
    every effect.
    """
    calibration = dataclasses.replace(calibration, baseline=NEGLIGIBLE)
    temper = calibration.temper(arms.unseen[()], arms.noise, arms.count)
    share = share_of_motion(arms.motion, arms.count > 0)
    return {
        effects: student_log_likelihoods(
            arms.count * ((error / arms.noise) ** 2 - 1.0) / temper, calibration.freedom, share
        ).sum()
        - calibration.term_cost * len(effects)
        for effects, error in arms.unseen.items()
    }
