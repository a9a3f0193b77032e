"""Measures what each of several recordings adds to a diagnosis, and whether they contradict one another.

The log likelihood of an explanation is a sum over episodes (see `belief`), and therefore over recordings: each adds
some nats for one explanation against another, at the parameters that fit all recordings.

Recordings contradict one another if the best explanation by an effect needs different parameters for each. This is
tested even if "no effect" is more probable, since an effect in one recording only fits no other. The explanation is
fitted to every recording alone, starting from the fit to all. For K recordings of one set-up and P parameters, twice
the nats gained in sum have a chi-squared distribution with P (K - 1) degrees of freedom (Wilks). Every separate fit
includes its prior, but the nats do not, or a recording that shows nothing of the effect would gain by the prior alone;
no other fit gains less, which makes the test cautious.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import softmax
from scipy.stats import chi2

from cablejax.diagnose.belief import effect_names
from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, evaluate, improve
from cablejax.diagnose.search import Search
from cablejax.gaplog_join import recordings
from cablejax.types import GapLog

UNLIKELY = 1e-3
"""Recordings contradict one another where chance alone would make them differ as much less often than this."""
_REJECTED = 2
"""Explanations with which one is compared that alone is left."""


@dataclasses.dataclass(frozen=True)
class Round:
    """Contribution of one recording to a diagnosis.

    Attributes:
        name: of the recording.
        episodes: how many it has.
        nats: by which it speaks for each explanation that the whole leaves open against the most probable one; that one
            has 0. Where the whole leaves one alone, for the best of the rejected ones with as many effects. With what
            is believed beforehand and as calibrated, they add up to the logarithm of the odds.
        probability: of these explanations after this recording and those before it, with the parameters that fit all.
        own_gain: nats that parameters of its own would gain for the most probable explanation by an effect.
    """

    name: str
    episodes: int
    nats: dict[str, float]
    probability: dict[str, float]
    own_gain: float


@dataclasses.dataclass(frozen=True)
class Rounds:
    """Contribution of every recording, in the order given.

    Attributes:
        rounds: one for each recording.
        contradiction: how likely recordings of one set-up differ as much by chance; None where no effect was fitted.
    """

    rounds: tuple[Round, ...]
    contradiction: float | None

    @property
    def contradictory(self) -> bool:
        """Whether the recordings contradict one another."""
        return self.contradiction is not None and self.contradiction < UNLIKELY

    @property
    def odd_one(self) -> Round:
        """The recording that would gain most by parameters of its own."""
        return max(self.rounds, key=lambda one: one.own_gain)


def rounds_of(log: GapLog, found: Search) -> Rounds | None:
    """Contribution of each recording of a joined log; None for a log of one recording.

    Args:
        log: as `cablejax.gaplog_join.joined` makes it.
        found: explanations of all its episodes.

    Raises:
        GapLogError: what the log says of its recordings does not add up to its episodes.
    """
    parts = recordings(log)
    if len(parts) < 2:
        return None
    evidence, (kept, _) = found.evidence, found.in_doubt()
    if len(kept) == 1:
        effects = len(kept[0].explanation.terms)
        rejected = [fit for fit in found.fits if fit is not kept[0] and len(fit.explanation.terms) == effects]
        kept = [kept[0], *rejected[:_REJECTED]]
    names = [" + ".join(effect_names(fit.explanation)) or "nominal" for fit in kept]
    each = np.stack([evidence.log_likelihoods(fit.held_out_sse(evidence)) for fit in kept])
    score = {id(fit): value for fit, value in zip(found.fits, found.scores, strict=True)}
    believed = np.array([score[id(fit)] for fit in kept]) - each.sum(axis=1)
    ends = np.cumsum([part["episodes"] for part in parts])
    rows = [np.arange(end - part["episodes"], end) for part, end in zip(parts, ends, strict=True)]
    tested = next((fit for fit in [kept[0], *found.fits] if fit.explanation.terms), kept[0])
    gains = [_own_gain(tested, evidence, own) for own in rows]
    rounds = []
    for part, own, end, gain in zip(parts, rows, ends, gains, strict=True):
        nats = each[:, own].sum(axis=1)
        chances = softmax(believed + each[:, :end].sum(axis=1))
        rounds.append(
            Round(
                name=part["name"],
                episodes=part["episodes"],
                nats=dict(zip(names, (nats - nats[0]).tolist(), strict=True)),
                probability=dict(zip(names, chances.tolist(), strict=True)),
                own_gain=gain,
            )
        )
    freedom = len(tested.explanation.z) * (len(parts) - 1)
    chance = float(chi2.sf(2.0 * sum(gains), freedom)) if freedom else None
    return Rounds(tuple(rounds), chance)


def _own_gain(fit: Fit, evidence: Evidence, rows: np.ndarray) -> float:
    """Nats of likelihood that a fit to these episodes alone gains."""
    if not len(fit.explanation.z):
        return 0.0
    alone = evidence.restricted(rows)
    (start,) = evaluate(alone, [fit.explanation])
    (own,) = improve(alone, [start], evidence.simulator.plan.last_steps)
    return max(start.misfit(alone) - own.misfit(alone), 0.0)
