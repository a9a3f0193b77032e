"""Corrects a diagnosed simulator with a ridge regression on the clamps' history and the simulated
cable.

The correction of every free marker is a linear function of `features`, in a frame that moves with the clamps: the
clamps' positions and directions over the last 0.4 s, the simulated markers and their velocities, and products of the
leading principal components of all these. It reads the simulation and the grippers, never an observation, so it
predicts open loop as far as the simulator does.

Number of components and regularisation are chosen by leaving out recordings.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.refits import dealt
from cablejax.spatial.windows import Windows
from real_cables.features import clamp_history, earlier, in_frame, moving_frame

_VELOCITY = 0.05  # [s], over which the simulated markers' velocity is taken
_COMPONENTS = (0, 8, 16, 24)
_RIDGES = (1e1, 1e2, 1e3, 1e4, 1e5)
_EVERY = 3
_FOLDS = 5


@dataclasses.dataclass(frozen=True)
class RidgeResidual:
    """A fitted correction.

    Attributes:
        centre, scale: of the linear features, shape [K].
        components: leading directions of the scaled features, shape [K, C].
        weights: of constant, features and products, shape [M, 3 F].
        ridge: regularisation that was chosen.
        unseen: error on recordings left out, before and after [m].
    """

    centre: Float[np.ndarray, "K"]
    scale: Float[np.ndarray, "K"]
    components: Float[np.ndarray, "K C"]
    weights: Float[np.ndarray, "M O"]
    ridge: float
    unseen: tuple[float, float]

    def correct(self, simulated: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W T F 3"]:
        """The simulation with what it is expected to miss added [m]. The first two samples stay."""
        frame, linear = _linear(simulated, windows)
        rows = _expand((linear.reshape(-1, linear.shape[-1]) - self.centre) / self.scale, self.components)
        local = (rows @ self.weights).reshape(*simulated.shape)
        added = np.einsum("wtfk,wtkc->wtfc", local, frame)
        added[:, :2] = 0.0
        return simulated + added


def fit_residual(simulated: Float[np.ndarray, "W T F 3"], windows: Windows) -> RidgeResidual:
    """Fits the correction to windows, and what is free in it by leaving out recordings.

    Args:
        simulated: free markers as the simulator has them [m].
        windows: the same windows as recorded.
    """
    frame, linear = _linear(simulated, windows)
    miss = windows.keypoints - simulated
    use = windows.valid & np.isfinite(miss).all(axis=(2, 3))
    use[:, :2] = False
    use &= (np.arange(use.shape[1]) % _EVERY == 2)[None]
    target = np.einsum("wtfc,wtkc->wtfk", np.nan_to_num(miss), frame)[use].reshape(use.sum(), -1)
    features, fold = linear[use], dealt(windows.group, _FOLDS)[np.nonzero(use)[0]]
    centre, scale = features.mean(axis=0), features.std(axis=0) + 1e-6
    scaled = (features - centre) / scale
    _, _, directions = np.linalg.svd(scaled[:: max(1, len(scaled) // 4000)], full_matrices=False)

    best = None
    for count in _COMPONENTS:
        components = directions[:count].T / np.sqrt(np.maximum((scaled @ directions[:count].T).var(axis=0), 1e-9))
        rows = _expand(scaled, components)
        error = np.zeros((len(_RIDGES), len(rows)))
        grams = [(rows[fold == k].T @ rows[fold == k], rows[fold == k].T @ target[fold == k]) for k in np.unique(fold)]
        gram_all, moment_all = (np.sum([g[j] for g in grams], axis=0) for j in range(2))
        for k, (gram, moment) in zip(np.unique(fold), grams, strict=True):
            for r, ridge in enumerate(_RIDGES):
                weights = _solve(gram_all - gram, moment_all - moment, ridge)
                error[r, fold == k] = np.abs(rows[fold == k] @ weights - target[fold == k]).mean(axis=1)
        score = error.mean(axis=1)
        r = int(score.argmin())
        if best is None or score[r] < best[0]:
            best = score[r], components, _RIDGES[r], _solve(gram_all, moment_all, _RIDGES[r])
    assert best is not None
    return RidgeResidual(centre, scale, best[1], best[3], best[2], (float(np.abs(target).mean()), float(best[0])))


def _solve(gram, moment, ridge):
    penalty = np.full(len(gram), ridge)
    penalty[0] = 1e-6  # the constant is free
    return np.linalg.solve(gram + np.diag(penalty), moment)


def _expand(scaled, components):
    parts = [np.ones((len(scaled), 1)), scaled]
    if components.shape[1]:
        lead = np.clip(scaled @ components, -4.0, 4.0)
        pairs = list(itertools.combinations_with_replacement(range(components.shape[1]), 2))
        parts.append(np.stack([lead[:, i] * lead[:, j] for i, j in pairs], axis=1))
    return np.concatenate(parts, axis=1)


def _linear(simulated, windows):
    """The moving frame, shape [W, T, 3, 3], rows are axes, and the linear features, shape [W, T, K]."""
    frame, middle = moving_frame(windows), windows.position.mean(axis=2, keepdims=True)
    back = max(1, round(_VELOCITY / windows.interval))
    markers = [in_frame(simulated - middle, frame), in_frame(simulated - earlier(simulated, back), frame)]
    flat = [part.reshape(*part.shape[:2], -1) for part in markers]
    return frame, np.concatenate([clamp_history(windows, frame), *flat], axis=-1)
