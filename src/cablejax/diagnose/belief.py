"""Probabilities of explanations from their fits.

A simulator that has the right effect still differs from a real cable, by more samples than a likelihood of white noise
believes independent, and by more where the effect is large. So the squared error of each episode, above the noise, is
measured against

    temper_e = 1 + n (b^2 + (rho g_e)^2) / sigma^2,      Q_e = (SSE_e - count_e) / temper_e,

with b the error of the baseline simulator, rho the relative error of an effect's law (real friction is not quite
Coulomb's), g_e the gap of that episode, sigma the noise, and n the number of samples over which these errors stay the
same, at most all of the episode. An explanation's log likelihood is that of Student's distribution over episodes,

    log p(log | c) = -(nu + 1) / 2 sum_e log(1 + Q_e / nu),

so that no single episode, where the cable snapped a moment too early, decides alone. `SSE_e` comes from a fit that left
out episode e: parameters that serve one episode only cost more than they gain.

Whether an explanation is complete is a conformal test (Vovk, Gammerman and Shafer 2005). The score of an explanation is
what it leaves over what `Calibration.complete` allows. On labelled logs of other simulators that show one effect of the
library, the right explanation has the scores in `SCORES`. If a new log is like these and its explanation right, its
score is as likely to be at any rank among them: the p-value is the share of scores at least as high, the new one
counted. An explanation that is not complete, with a score above 1, has p <= 3 / 81.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from cablejax.diagnose.evidence import Evidence, episodes_by_motion
from cablejax.diagnose.fit import Fit
from cablejax.diagnose.protocol import Explanation

LEAST_SQUARES = 1e12
"""Degrees of freedom with which Student's distribution is a normal one."""
# In the logs on which `Calibration.as_good` was set.
_MOTIONS = 6
# fmt: off
SCORES = (
    0.00, 0.00, 0.00, 0.03, 0.06, 0.08, 0.08, 0.09, 0.10, 0.10, 0.11, 0.12, 0.13, 0.13, 0.14, 0.16,
    0.16, 0.16, 0.16, 0.18, 0.18, 0.19, 0.19, 0.21, 0.23, 0.23, 0.24, 0.26, 0.26, 0.27, 0.27, 0.27,
    0.27, 0.27, 0.28, 0.29, 0.29, 0.29, 0.29, 0.29, 0.30, 0.30, 0.30, 0.31, 0.31, 0.34, 0.36, 0.36,
    0.36, 0.37, 0.37, 0.38, 0.38, 0.39, 0.39, 0.39, 0.39, 0.42, 0.44, 0.45, 0.45, 0.45, 0.47, 0.47,
    0.48, 0.50, 0.52, 0.52, 0.53, 0.55, 0.56, 0.60, 0.61, 0.70, 0.72, 0.79, 0.87, 0.97, 1.30, 1.85,
)
# fmt: on
"""Of 80 logs of the blind check of seed 20270404, printed by `python experiments/22_blind_score.py
docs/results/blind/20270404/cases.jsonl --leftovers`."""

BESIDE_UNKNOWN = 0.27
"""Share of the effects named beside an unknown cause that are causes, or have a cause among their look-alikes: 14 of 51
in the blind checks from seed 20270404 to 20301125, as `experiments/22_blind_score.py` prints for each."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Constants that were set on labelled development logs, see docs/results/diagnosis.md.

    Attributes:
        baseline: root mean square error per coordinate of the simulator without any effect, in the unit of the
            observations; commissioning logs replace it.
        law_error: rho, of an effect's law relative to the gap it makes.
        correlated_samples: n, over which errors of simulators persist; at most all samples of an episode.
        freedom: nu of Student's distribution.
        fit_freedom: the same in fits; `LEAST_SQUARES` where episodes are so few that a fit must not discount any.
        term_cost: cost of each effect [nats].
        prior_cost: share of the nats of its parameters' prior that an effect costs in addition. The constants for logs
            on a table were set with 0.
        resolvable: errors up to this many baseline errors are not a gap, see `has_gap`.
        noise_share: share of the noise that is added to the baseline error in that comparison, since the noise floor
            itself is an estimate.
        adequate: an explanation that leaves less than this share of the gap, root mean square, is complete.
        telling: smallest share of explained squared gap for which an effect is named, unless most motions are explained
            completely.
        set_odds: an effect belongs to the reported set if its odds against the best are at least these;
        as_good: or if its remaining error is at most this many times the best one's, in six motions or more, see the
            function `as_good`.
        widening: factor on the intervals of parameters, for errors of the fitted law.
        max_effects: most effects in one explanation; a repeated effect counts once.
    """

    baseline: float = 3.5e-4
    law_error: float = 0.1
    correlated_samples: float = 800.0
    freedom: float = 6.0
    fit_freedom: float = 6.0
    term_cost: float = 4.0
    prior_cost: float = 0.0
    resolvable: float = 1.6
    noise_share: float = 0.15
    adequate: float = 0.25
    telling: float = 0.6
    set_odds: float = 0.08
    as_good: float = 1.25
    widening: float = 1.5
    max_effects: int = 3

    def __post_init__(self):
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"Calibration.{name} is {value}, expected a finite number that is not negative.")

    def temper(
        self,
        gap: Float[np.ndarray, "E"],
        noise: float,
        count: Float[np.ndarray, "E"] | int,
        own: Float[np.ndarray, "E"] | None = None,
    ) -> Float[np.ndarray, "E"]:
        """Temper of each episode, see the module; `own` replaces `baseline` as b, all in metres per coordinate."""
        together = np.minimum(self.correlated_samples, np.maximum(count, 1))
        return 1.0 + together * ((self.baseline if own is None else own) ** 2 + (self.law_error * gap) ** 2) / noise**2

    def smallest_gap(self, noise: float, own: float | None = None) -> float:
        """The smallest error that counts as a gap; `own` replaces `baseline` as the simulator's error."""
        return self.resolvable * float(np.hypot(self.baseline if own is None else own, self.noise_share * noise))

    def complete(self, left: float, gap: float, noise: float) -> bool:
        """Whether an explanation that leaves so much of the gap, all in metres per coordinate, needs no other."""
        return left <= self.may_leave(gap, noise)

    def needs_no_other(self, gap: float, noise: float) -> float:
        """The error below which a single effect is not combined with another one: its law may be off by as much.

        A complete one that leaves more is: it may take most of the gap by values that are in part another's.
        """
        return max(self.law_error * gap, self.smallest_gap(noise))

    def may_leave(self, gap: float, noise: float) -> float:
        """The largest error that a complete explanation may leave."""
        return max(self.adequate * gap, self.smallest_gap(noise))


def explains_most_motions(fit: Fit, null: Fit, evidence: Evidence, calibration: Calibration) -> bool:
    """Whether an explanation is complete for more than half of the motions that have a gap.

    A cause that acts at one place or one time leaves most motions to the other causes.
    """
    noise = level(evidence)
    left, gap = left_by_motion(fit, evidence), left_by_motion(null, evidence)
    done = [
        calibration.complete(after, before, noise)
        for after, before in zip(left, gap, strict=True)
        if before > calibration.smallest_gap(noise)
    ]
    return bool(done) and float(np.mean(done)) > 0.5


def as_good(fit: Fit, best: Fit, evidence: Evidence, calibration: Calibration) -> bool:
    """Whether a fit leaves little more than the best, over the whole log and in at least half of its motions.

    One motion that no effect explains would make all explanations look alike. What a law leaves differs from motion to
    motion, and of few it is known less well: by the root of their number.
    """
    least = np.maximum(left_by_motion(best, evidence), calibration.smallest_gap(level(evidence)))
    little = 1.0 + (calibration.as_good - 1.0) * max(1.0, np.sqrt(_MOTIONS / len(least)))
    whole = excess(fit, evidence) <= little * excess(best, evidence)
    return whole and float(np.mean(left_by_motion(fit, evidence) <= little * least)) >= 0.5


def left_by_motion(fit: Fit, evidence: Evidence) -> Float[np.ndarray, "M"]:
    """Remaining error of each motion that was seen, root mean square per coordinate above the noise."""
    squares, count = _squares_by_motion(fit, evidence)
    return level(evidence) * np.sqrt(np.maximum(squares, 0.0) / count)


def has_gap(null: Fit, evidence: Evidence, calibration: Calibration) -> bool:
    """Whether the nominal simulator is off by more than its own error, in the fourth-power mean over motions.

    With a root mean square, additional calm motions would hide a gap that some motions show. The expected contribution
    of noise to the fourth power, and twice its standard deviation, are subtracted. Each motion counts in units of the
    simulator's possible error in it, which is larger where the cable snaps through.
    """
    squares, count = _squares_by_motion(null, evidence)
    noise = level(evidence)
    own = np.full(len(evidence.count), calibration.baseline) if evidence.own_error is None else evidence.own_error
    smallest = np.array([calibration.smallest_gap(noise, float(own[rows].max())) for rows in _seen_motions(evidence)])
    unit = (noise / smallest) ** 4
    fourth = ((np.maximum(squares, 0.0) / count) ** 2 - 2.0 / count) * unit
    # of the square of a normal variable, whose variance is 2 / count
    chance = np.linalg.norm(2.0 * np.sqrt(2.0) / count * unit) / len(count)
    return float(np.mean(fourth) - 2.0 * chance) > 1.0


def excused(null: Fit, evidence: Evidence, calibration: Calibration) -> list[tuple[int, float, float]]:
    """Motions with a gap beyond the usual error of the simulator, in which it may be off by more than usual.

    Where the cable snaps over, for example. They say nothing for a gap, see `has_gap`, and nothing against one.

    Returns:
        The first episode of each, what the nominal simulator misses it by, and its own error there, both in metres per
        coordinate.
    """
    if evidence.own_error is None:
        return []
    usual = calibration.smallest_gap(level(evidence))
    return [
        (int(rows[0]), float(gap), own)
        for rows, gap in zip(_seen_motions(evidence), left_by_motion(null, evidence), strict=True)
        if usual < gap and usual < (own := float(evidence.own_error[rows].max()))
    ]


def _seen_motions(evidence: Evidence) -> list[Int[np.ndarray, "_"]]:
    """The episodes of each motion of which something was observed."""
    return [rows for rows in episodes_by_motion(evidence.motion) if evidence.count[rows].any()]


def _squares_by_motion(fit: Fit, evidence: Evidence) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Sum of squares above the noise, in its units, and number of coordinates, of each motion that was seen."""
    motions, count = _seen_motions(evidence), evidence.count
    return np.array([(fit.sse - count)[rows].sum() for rows in motions]), np.array([count[r].sum() for r in motions])


def excess(fit: Fit, evidence: Evidence) -> float:
    """Remaining error of a fit, root mean square per coordinate above the noise."""
    count = float(evidence.count.sum())
    return float(np.sqrt(max(float(fit.sse.sum()) - count, 0.0) / count)) * level(evidence)


def level(evidence: Evidence) -> float:
    """Noise of a coordinate, root mean square over all coordinates."""
    return float(np.sqrt(np.mean(evidence.noise**2)))


def log_scores(fits: Sequence[Fit], evidence: Evidence, calibration: Calibration) -> Float[np.ndarray, "F"]:
    """Log posterior of every explanation; sets with equally many effects have equal prior probability."""

    def score(fit: Fit) -> float:
        one = fit.explanation
        cost = calibration.term_cost * len(set(one.terms)) + calibration.prior_cost * 0.5 * float(one.z @ one.z)
        return float(evidence.log_likelihoods(fit.held_out_sse(evidence)).sum()) - cost

    return np.array([score(fit) for fit in fits])


def effect_names(explanation: Explanation) -> tuple[str, ...]:
    """Names of the distinct effects of an explanation, sorted."""
    return tuple(sorted(set(explanation.names)))


def best_by_effects(fits: Sequence[Fit], scores: Float[np.ndarray, "F"]) -> dict[tuple[str, ...], int]:
    """The best fit of every set of effects, by its index; variants and starts of one effect compete here."""
    best: dict[tuple[str, ...], int] = {}
    for i in np.argsort(-scores):
        best.setdefault(effect_names(fits[i].explanation), int(i))
    return best


def leftover_score(left: float, gap: float, noise: float, calibration: Calibration) -> float:
    """Remaining gap of an explanation, relative to that of a complete one; all in one unit."""
    return left / calibration.may_leave(gap, noise)


def leftover_p(score: float, right: Sequence[float] = SCORES) -> float | None:
    """Chance that a right explanation has a score at least as high; at least 1 / 81 for cables.

    Args:
        score: of the new explanation.
        right: scores of right explanations on labelled recordings that are like the new one.

    Returns:
        None where there are no such recordings.
    """
    return (1 + sum(other >= score for other in right)) / (len(right) + 1) if right else None
