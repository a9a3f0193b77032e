"""Expected information of a recording that has yet to be made: about which explanation holds, or about its parameters.

Under each explanation c, of posterior probability p_c, the recording is Gaussian: its mean is the prediction, and its
covariance is the noise and what the posterior of the explanation's own parameters leaves open,

    y | c ~ N(mu_c, I + A_c A_c'),      A_c = J_c L_c / sqrt(temper),

in units of the tempered noise, with J_c the derivatives by the parameters and L_c L_c' their posterior covariance. What
an explanation's own parameters can make up for does not count as a difference. The mutual information between c and y
has no closed form, but bounds by pairwise distances (Kolchinsky and Tracey 2017, Estimating mixture entropy with
pairwise distances),

    I(c; y) >= - sum_i p_i ln sum_j p_j exp(-B_ij),      I(c; y) <= - sum_i p_i ln sum_j p_j exp(-KL_ij),

with B the Bhattacharyya distance and KL the Kullback-Leibler divergence. Both are 0 where all explanations predict the
same, and the entropy of p where they predict quite different things. The lower bound is computed from less than B,

    B_ij >= (mu_i - mu_j)' (I + A_i A_i' + A_j A_j')^-1 (mu_i - mu_j) / 8,

in which explanations do not differ by their covariances alone: these rest on derivatives at two places, and wide
posteriors of one and the same effect would seem to differ.

Parameters are few and coordinates many, so every quantity comes from inner products of means and columns of A.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def entropy(chances: Float[np.ndarray, "K"]) -> float:
    """Entropy of probabilities [nats]: the doubt about which explanation holds."""
    kept = np.asarray(chances, float)
    kept = kept[kept > 0]
    return max(0.0, float(-(kept * np.log(kept)).sum()))


def mutual_information(
    means: Float[np.ndarray, "K M"], spreads: Sequence[Float[np.ndarray, "_ M"]], chances: Float[np.ndarray, "K"]
) -> tuple[float, float]:
    """Bounds on the mutual information between the explanation and a recording [nats].

    Args:
        means: predictions in units of the tempered noise.
        spreads: of each explanation, the rows of A', in the same units: how far one posterior standard deviation moves
            the prediction, in directions in which the posterior is independent. May have no rows.
        chances: probabilities of the explanations, sum 1.

    Returns:
        The lower and the upper bound, each between 0 and the entropy of `chances`.

    Raises:
        ValueError: the numbers of means, spreads and probabilities differ.
    """
    if not len(means) == len(spreads) == len(chances):
        raise ValueError(
            f"mutual_information got {len(means)} means, {len(spreads)} spreads and {len(chances)} probabilities, "
            "expected as many of each."
        )
    p = np.asarray(chances, float)
    products = _Products.of(np.asarray(means, float), [np.asarray(spread, float) for spread in spreads])
    count = len(p)
    near, far = np.zeros((count, count)), np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            if i < j:
                near[i, j] = near[j, i] = products.separation(i, j)
            if i != j:
                far[i, j] = products.divergence(i, j)
    doubt = entropy(p)
    lower, upper = (float(np.clip(_from_distances(d, p), 0.0, doubt)) for d in (near, far))
    return lower, upper


def parameter_information(spread: Float[np.ndarray, "P M"], nuisance: Float[np.ndarray, "Q M"]) -> float:
    """Expected information about the parameters of one explanation [nats].

    It is `1/2 ln det(I + A' S^-1 A)`, with S the covariance of noise and nuisances.

    Args:
        spread: as in `mutual_information`.
        nuisance: rows as those of `spread`, for what else moves the prediction and is not asked for.
    """
    nuisance = np.asarray(nuisance, float)
    both = np.concatenate([np.asarray(spread, float), nuisance])
    return 0.5 * (_log_det(both @ both.T) - _log_det(nuisance @ nuisance.T))


def _from_distances(distance: Float[np.ndarray, "K K"], p: Float[np.ndarray, "K"]) -> float:
    known = p > 0
    return float(-(p[known] * np.log((np.exp(-distance) @ p)[known])).sum())


class _Products:
    """Inner products of differences of means, and of columns of A, with the blocks that belong to one explanation."""

    def __init__(self, gram: np.ndarray, count: int, columns: list[slice]):
        self._gram, self._count, self._columns = gram, count, columns

    @classmethod
    def of(cls, means: np.ndarray, spreads: list[np.ndarray]) -> _Products:
        # a common offset of all means would cost digits
        rows = [means - means[:1], *spreads]
        ends = np.cumsum([len(row) for row in rows])
        every = np.concatenate(rows)
        blocks = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        return cls(every @ every.T, len(means), blocks)

    def _difference(self, i: int, j: int) -> tuple[float, np.ndarray]:
        """Squared length of mu_i - mu_j, and its products with all rows."""
        row = self._gram[i] - self._gram[j]
        return float(row[i] - row[j]), row

    def separation(self, i: int, j: int) -> float:
        """Less than the Bhattacharyya distance: both explanations' parameters may make up for all of the difference."""
        square, row = self._difference(i, j)
        both = np.r_[self._columns[i], self._columns[j]]
        inner = np.eye(len(both)) + self._gram[np.ix_(both, both)]
        return max(0.125 * float(square - row[both] @ np.linalg.solve(inner, row[both])), 0.0)

    def divergence(self, i: int, j: int) -> float:
        """KL divergence of the distribution under i from that under j."""
        a, b = self._columns[i], self._columns[j]
        square, row = self._difference(i, j)
        inner = np.eye(b.stop - b.start) + self._gram[b, b]
        across = self._gram[b, a]
        trace = np.trace(self._gram[a, a]) - np.trace(
            np.linalg.solve(inner, self._gram[b, b] + across @ across.T)
        )  # of S_j^-1 S_i, less the number of coordinates
        far = square - float(row[b] @ np.linalg.solve(inner, row[b]))
        return max(0.5 * (float(trace) + far + _log_det(self._gram[b, b]) - _log_det(self._gram[a, a])), 0.0)


def _log_det(gram: Float[np.ndarray, "P P"]) -> float:
    """Of I + gram; 0 without parameters."""
    return float(np.linalg.slogdet(np.eye(len(gram)) + gram)[1])
