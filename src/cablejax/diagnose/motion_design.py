"""Designs a gripper motion by an evolution strategy over paths, in coordinates of the line between the grippers.

A way has four legs. The strategy is CMA-ES with a diagonal covariance (Ros and Hansen 2008, A simple modification in
CMA-ES achieving linear time and space complexity): each generation is judged in one batch of simulations, motions that
break a bound rank behind all others, those that break it least first.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.motion_bounds import BoundsError
from cablejax.diagnose.motion_judge import Judge, Judged
from cablejax.diagnose.safe_motions import Way

Ended = Literal["clear", "settled", "budget"]
"""Why a search ended: next to no doubt would be left, no better motion came for some generations from any start, or its
budget of simulations."""

LEGS = 4
"""Of a designed motion."""
_SLOWEST = 0.1
_REST = 3.0
# Changes of a place of a way: its middle [lengths of the cable], heading [rad], distance [lengths], angles [rad].
_SCALES = np.array([0.06, 0.06, 0.2, 0.08, 0.3, 0.3])
_SHARE_SCALE = 0.4
# Bounds that the grippers break cost no simulation, but time.
_MOST_GENERATIONS = 150


@dataclasses.dataclass(frozen=True)
class DesignConfig:
    """Effort of the search for a motion.

    Attributes:
        simulations: that are made at most.
        population: motions of a generation.
        step: first standard deviation of the search, in changes that matter: 0.06 to 0.08 lengths, 0.2 to 0.3 rad.
        clear: the search ends once no more than this share of the doubt would be left.
        tolerance: a generation counts as better if it lowers the doubt that would be left by this share, or, where the
            information is that about parameters, adds this to it [nats].
        patience: the search from one motion ends after so many generations that were not better.
        starts: motions to search from, one after the other, best first.
        seed: of the search.
    """

    simulations: int = 8000
    population: int = 16
    step: float = 0.5
    clear: float = 0.002
    tolerance: float = 0.03
    patience: int = 8
    starts: int = 4
    seed: int = 0


def design_motion(
    judge: Judge,
    ways: Mapping[str, Way],
    judged: Mapping[str, Judged],
    n_samples: int,
    config: DesignConfig = DesignConfig(),
) -> tuple[Judged, Ended]:
    """Searches for the motion with the most information that keeps all bounds, from the best few of given ones.

    Args:
        judge: of motions.
        ways: to start from, by name.
        judged: their motions, by the same names.
        n_samples: of the motion.
        config: effort of the search.

    Returns:
        The best of all motions that were judged, and why the search ended.

    Raises:
        BoundsError: no motion that was tried keeps all bounds; says how many each bound excludes.
    """
    order = sorted(judged, key=lambda name: _rank(judged[name]))
    best, tried, made, generations = judged[order[0]], list(judged.values()), 0, 0
    ended: Ended = "settled"
    for restart, name in enumerate(order[: config.starts]):
        genome = _Genome(ways[name], judge, n_samples)
        strategy = _Strategy(genome.size, config, restart)
        leader, stale = judged[name], 0
        while stale < config.patience or best.beyond:
            if _left(judge, best) <= config.clear * judge.doubt:
                ended = "clear"
                break
            if made >= config.simulations or generations >= _MOST_GENERATIONS:
                ended = "budget"
                break
            generations += 1
            points = strategy.ask()
            every = judge.judged([genome.poses(point) for point in points])
            tried += every
            strategy.tell(points, sorted(range(len(every)), key=lambda i: _rank(every[i])))
            found = min(every, key=_rank)
            stale = 0 if _better(judge, found, leader, config.tolerance) else stale + 1
            leader = min(leader, found, key=_rank)
            best = min(best, found, key=_rank)
            made += judge.simulations * sum(one.keypoints is not None for one in every)
        if ended != "settled":
            break
    if best.beyond:
        raise BoundsError(excluded(tried))
    return best, ended


def excluded(tried: list[Judged]) -> str:
    """A sentence on how many motions each bound excludes."""
    words = excluded_by(one.beyond for one in tried)
    return (
        f"No motion keeps all bounds: of the {len(tried)} motions tried, {words}. Relax the first of these bounds, or "
        "record a log that starts further inside them."
    )


def excluded_by(broken: Iterable[Iterable[str]]) -> str:
    """In words, how many motions each bound excludes; `broken` has the names of the bounds that each motion breaks."""
    counts = collections.Counter(name for names in broken for name in names)
    return ", ".join(f"{name} excludes {count}" for name, count in counts.most_common())


class _Genome:
    """Ways as points of a search: changes of a given way, 0 = none."""

    def __init__(self, way: Way, judge: Judge, n_samples: int):
        missing = LEGS - len(way.shares)
        if missing < 0:
            raise ValueError(f"The way has {len(way.shares)} legs, expected at most {LEGS}.")
        last = np.repeat(way.places[-1:], missing, axis=0)
        self._way = Way(
            places=np.concatenate([way.places, last]),
            shares=np.concatenate([way.shares, np.ones(missing)]),
            holds=np.concatenate([way.holds, np.ones(missing)]),
        )
        self._bounds, self._samples = judge.bounds, n_samples
        length = judge.playback.config.cable.length
        self._scales = _SCALES * [length, length, 1.0, length, 1.0, 1.0]
        self._distances = judge.bounds.distances(length)

    @property
    def size(self) -> int:
        return LEGS * 7

    def poses(self, point: Float[np.ndarray, "S"]) -> Float[np.ndarray, "T 2 3"]:
        places = self._way.places.copy()
        places[1:] += self._scales * point[: LEGS * 6].reshape(LEGS, 6)
        places[:, 3] = np.clip(places[:, 3], *self._distances)
        shares = np.clip(self._way.shares * np.exp(_SHARE_SCALE * point[LEGS * 6 :]), _SLOWEST, 1.0)
        changed = dataclasses.replace(self._way, places=places, shares=shares)
        return changed.played(self._samples, self._bounds, rest=_REST)


class _Strategy:
    """CMA-ES with a diagonal covariance; constants and names as in its paper."""

    def __init__(self, size: int, config: DesignConfig, restart: int):
        self._random = np.random.default_rng([config.seed, restart])
        self._count, self._parents = config.population, config.population // 2
        weights = math.log(self._parents + 0.5) - np.log(np.arange(1, self._parents + 1))
        self._weights = weights / weights.sum()
        self._effective = float(1.0 / (self._weights**2).sum())
        n, mu = size, self._effective
        self._cs = (mu + 2) / (n + mu + 5)
        self._damping = 1 + self._cs + 2 * max(0.0, math.sqrt((mu - 1) / (n + 1)) - 1)
        self._cc = 4 / (n + 4)
        full = 2 / (mu * (n + math.sqrt(2)) ** 2)
        full += (1 - 1 / mu) * min(1.0, (2 * mu - 1) / ((n + 2) ** 2 + mu))
        self._ccov = min(1.0, full * (n + 2) / 3)
        self._expected = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
        self._mean, self._variance, self._step = np.zeros(n), np.ones(n), config.step
        self._path, self._step_path = np.zeros(n), np.zeros(n)

    def ask(self) -> Float[np.ndarray, "C S"]:
        """The points of a generation."""
        draws = self._random.standard_normal((self._count, len(self._mean)))
        return self._mean + self._step * np.sqrt(self._variance) * draws

    def tell(self, points: Float[np.ndarray, "C S"], order: list[int]) -> None:
        """Moves on to the next generation, from the points in order of merit."""
        steps = (points[order[: self._parents]] - self._mean) / self._step
        moved = self._weights @ steps
        self._mean = self._mean + self._step * moved
        keep = math.sqrt(self._cs * (2 - self._cs) * self._effective)
        self._step_path = (1 - self._cs) * self._step_path + keep * moved / np.sqrt(self._variance)
        keep = math.sqrt(self._cc * (2 - self._cc) * self._effective)
        self._path = (1 - self._cc) * self._path + keep * moved
        share = 1 / self._effective
        self._variance = (1 - self._ccov) * self._variance + self._ccov * (
            share * self._path**2 + (1 - share) * (self._weights @ steps**2)
        )
        length = float(np.linalg.norm(self._step_path))
        self._step *= math.exp(self._cs / self._damping * (length / self._expected - 1))


def _rank(one: Judged) -> tuple[bool, bool, float]:
    """Sorts motions: those that keep all bounds by their information, then those whose cable breaks one."""
    if one.beyond:
        return True, one.keypoints is None, sum(one.beyond.values())
    return False, False, -one.information


def _left(judge: Judge, one: Judged) -> float:
    """Doubt that is expected to be left [nats]; about parameters there is always some."""
    if one.beyond or (judge.about_parameters and any(len(e.z) for e in judge.explanations)):
        return math.inf
    return judge.doubt - one.information


def _better(judge: Judge, one: Judged, other: Judged, tolerance: float) -> bool:
    """Whether one motion is better than another by more than the tolerance."""
    if one.beyond or other.beyond:
        return _rank(one) < _rank(other)
    if judge.about_parameters:
        return one.information > other.information + tolerance
    return _left(judge, one) < (1 - tolerance) * _left(judge, other)
