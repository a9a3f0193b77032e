"""Expected information of a future recording about which explanation holds, or about its parameters.

Under each explanation c, of posterior probability p_c, the recording is Gaussian: its mean is the prediction, and its
covariance is the noise and what the posterior of the explanation's own parameters leaves open,

    y | c ~ N(mu_c, I + A_c A_c'),      A_c = J_c L_c / sqrt(temper),

in units of the tempered noise, with J_c the derivatives by the parameters and L_c L_c' their posterior covariance. What
an explanation's own parameters can make up for does not count as a difference. The mutual information between c and y
has no closed form, but a lower bound by pairwise distances (Kolchinsky and Tracey 2017, Estimating mixture entropy
with pairwise distances),

    I(c; y) >= - sum_i p_i ln sum_j p_j exp(-B_ij),

with B the Bhattacharyya distance. The bound is 0 where all explanations predict the same, and the entropy of p where
they predict quite different things. It is computed from less than B,

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
) -> float:
    """Lower bound on the mutual information between the explanation and a recording [nats].

    Args:
        means: predictions in units of the tempered noise.
        spreads: of each explanation, the rows of A', in the same units: how far one posterior standard deviation moves
            the prediction, in directions in which the posterior is independent. May have no rows.
        chances: probabilities of the explanations, sum 1.

    Returns:
        A number between 0 and the entropy of `chances`.

    Raises:
        ValueError: the numbers of means, spreads and probabilities differ.
    """
    if not len(means) == len(spreads) == len(chances):
        raise ValueError(
            f"mutual_information got {len(means)} means, {len(spreads)} spreads and {len(chances)} probabilities, "
            "expected as many of each."
        )
    p, means = np.asarray(chances, float), np.asarray(means, float)
    # a common offset of all means would cost digits
    rows = [means - means[:1], *(np.asarray(spread, float) for spread in spreads)]
    every = np.concatenate(rows)
    gram = every @ every.T
    columns = np.split(np.arange(len(every)), np.cumsum([len(part) for part in rows])[:-1])[1:]
    distance = np.zeros((len(p), len(p)))
    for i, j in itertools.combinations(range(len(p)), 2):
        # products of the difference of both means with all rows; what both explanations' parameters can make up for
        row, both = gram[i] - gram[j], np.concatenate([columns[i], columns[j]])
        inner = np.eye(len(both)) + gram[np.ix_(both, both)]
        apart = row[i] - row[j] - row[both] @ np.linalg.solve(inner, row[both])
        distance[i, j] = distance[j, i] = max(0.125 * float(apart), 0.0)
    known = p > 0
    lower = -(p[known] * np.log((np.exp(-distance) @ p)[known])).sum()
    return float(np.clip(lower, 0.0, entropy(p)))


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


def _log_det(gram: Float[np.ndarray, "P P"]) -> float:
    """Of I + gram; 0 without parameters."""
    return float(np.linalg.slogdet(np.eye(len(gram)) + gram)[1])
