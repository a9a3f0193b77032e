"""Corrects a diagnosed simulator with a graph network on the chain of markers.

Nodes are the two clamps and the free markers as the rod has them, edges connect markers at most two apart. A node
knows its simulated position, how it moved over the last 0.05 to 0.4 s, and its place along the cable; a clamp also its
direction. What the clamps do reaches the markers by messages, as in `cablejax.dynamics.networks` (Sanchez-Gonzalez et
al., 2020). The output is the correction of each free marker in the frame that moves with the clamps, so it predicts
open loop as far as the rod does; a network that has learned nothing corrects nothing.

Size and number of rounds are those with the least error on recordings left out.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Float

from cablejax.diagnose.refits import dealt
from cablejax.dynamics.config import ModelConfig
from cablejax.dynamics.graph import topology_of
from cablejax.dynamics.networks import EncodeProcessDecode
from cablejax.simulate.compile import compiler_options
from cablejax.spatial.windows import Windows
from real_cables.features import earlier, in_frame, moving_frame

_MOVED = (0.05, 0.1, 0.2, 0.4)  # [s]
_SIZES = (16, 32)
_PASSES = 3
_REACH = 2
_ROUNDS = 12
_STEPS = 50
_BATCH = 64
_RATE = 1e-3
_DECAY = 1e-3
# Weights are averaged over about so many steps before they are judged or used.
_AVERAGED = 100
_FOLDS = 3
_JUDGED = 1024
_EVERY = 3


@dataclasses.dataclass(frozen=True)
class NetworkResidual:
    """A trained correction.

    Attributes:
        size: of latent vectors.
        rounds: of training.
        weights: of the network; None without rounds.
        scales: of node and edge features: their mean and standard deviation.
        unit: of the correction [m].
        left_out: the training windows' simulation, each corrected by a network trained on other recordings [m].
        unseen: mean error on recordings left out, before and after [m].
    """

    size: int
    rounds: int
    weights: Any
    scales: tuple[tuple[np.ndarray, np.ndarray], ...]
    unit: float
    left_out: Float[np.ndarray, "W T F 3"]
    unseen: tuple[float, float]

    def correct(self, simulated: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W T F 3"]:
        """The simulation with what it is expected to miss added [m]. The first two samples stay."""
        if not self.rounds:
            return simulated
        programs = _programs(_config(windows, self.size), (len(self.scales[0][0]), len(self.scales[1][0])))
        return _corrected(programs, self.weights, self.scales, self.unit, simulated, windows)


def fit_network(
    simulated: Float[np.ndarray, "W T F 3"],
    windows: Windows,
    *,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> NetworkResidual:
    """Trains the correction on windows; size and rounds are chosen by leaving out recordings.

    Args:
        simulated: free markers as the simulator has them [m].
        windows: the same windows as recorded.
        seed: of first weights and batches.
        progress: called with a line of text.
    """
    frame, parts = moving_frame(windows), _features(simulated, windows)
    miss = windows.keypoints - simulated
    use = windows.valid & np.isfinite(miss).all(axis=(2, 3))
    use[:, :2] = False
    use &= (np.arange(use.shape[1]) % _EVERY == 2)[None]
    part_of = dealt(windows.group, _FOLDS)
    fold, rows = part_of[np.nonzero(use)[0]], [part[use] for part in parts]
    flat = [row.reshape(-1, row.shape[-1]) for row in rows]
    scales = tuple((row.mean(axis=0), row.std(axis=0) + 1e-3) for row in flat)
    target = in_frame(np.nan_to_num(miss), frame)[use]
    unit = float(np.sqrt((target**2).mean()))
    data = (*_scaled(rows, scales), jnp.asarray(target / unit, jnp.float32))
    before, shapes = np.abs(target).mean(), (rows[0].shape[-1], rows[1].shape[-1])

    found = {}
    for size in _SIZES:
        programs, left = _programs(_config(windows, size), shapes), {}
        curve = np.zeros(_ROUNDS + 1)
        for k in np.unique(fold):
            inside, outside = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
            left[k] = list(_rounds(programs, data, inside, seed, _ROUNDS))
            errors = [unit * _error(programs, weights, data, outside) for weights in left[k]]
            curve += np.array([np.abs(target[outside]).mean(), *errors]) * len(outside) / len(fold)
        progress(
            f"graph network of size {size}: {1e3 * before:.2f} -> {1e3 * curve.min():.2f} mm on recordings left out, "
            f"after {curve.argmin()} of {_ROUNDS} rounds"
        )
        found[size] = curve, left
    size = min(found, key=lambda s: found[s][0].min())
    curve, left = found[size]
    programs, rounds = _programs(_config(windows, size), shapes), int(curve.argmin())
    corrected = simulated.copy()
    if rounds:
        for k, kept in left.items():
            index = np.flatnonzero(part_of == k)
            shown = windows.chosen(index)
            corrected[index] = _corrected(programs, kept[rounds - 1], scales, unit, simulated[index], shown)
    trained = list(_rounds(programs, data, np.arange(len(fold)), seed, rounds))
    weights = trained[-1] if trained else None
    return NetworkResidual(size, rounds, weights, scales, unit, corrected, (float(before), float(curve.min())))


class _Programs(NamedTuple):
    """Where training begins from a seed; one round of it; the network on a batch."""

    begin: Callable
    round: Callable
    run: Callable


@functools.lru_cache(maxsize=8)
def _programs(config: ModelConfig, shapes: tuple[int, int]) -> _Programs:
    optimiser = optax.adamw(_RATE, weight_decay=_DECAY)
    graph = nnx.graphdef(EncodeProcessDecode(shapes, 3, config, nnx.Rngs(0)))

    def first(seed):
        return nnx.state(EncodeProcessDecode(shapes, 3, config, nnx.Rngs(seed)), nnx.Param)

    def run(weights, nodes, edges):
        return jax.vmap(nnx.merge(graph, weights))(nodes, edges)[:, 1:-1]

    def loss(weights, nodes, edges, target):
        miss = run(weights, nodes, edges) - target
        return jnp.mean(jnp.sqrt(1 + miss**2) - 1)

    def step(carry, index, data):
        weights, average, memory = carry
        slope = jax.grad(loss)(weights, *(part[index] for part in data))
        change, memory = optimiser.update(slope, memory, weights)
        weights = optax.apply_updates(weights, change)
        average = jax.tree.map(lambda a, w: a + (w - a) / _AVERAGED, average, weights)
        return (weights, average, memory), None

    def one_round(carry, indices, data):
        return jax.lax.scan(lambda c, i: step(c, i, data), carry, indices)[0]

    def begun(seed):
        weights = first(seed)
        return weights, weights, optimiser.init(weights)

    options = compiler_options()
    return _Programs(begun, jax.jit(one_round, compiler_options=options), jax.jit(run, compiler_options=options))


def _rounds(programs: _Programs, data, index, seed, count):
    """Averaged weights after every round of training on the rows `index`."""
    generator, carry = np.random.default_rng(seed), programs.begin(seed)
    for _ in range(count):
        carry = programs.round(carry, jnp.asarray(generator.choice(index, (_STEPS, _BATCH))), data)
        yield carry[1]


def _error(programs: _Programs, weights, data, index) -> float:
    """Mean absolute error of a coordinate in units of the correction; batches of one size, of evenly spread rows."""
    index = index[np.linspace(0, len(index) - 1, _JUDGED).astype(int)]
    *inputs, target = (part[index] for part in data)
    return float(jnp.abs(programs.run(weights, *inputs) - target).mean())


def _corrected(programs: _Programs, weights, scales, unit, simulated, windows):
    frame, rows = moving_frame(windows), _features(simulated, windows)
    local = [np.asarray(programs.run(weights, *_scaled([row[w] for row in rows], scales))) for w in range(len(windows))]
    added = unit * np.einsum("wtfk,wtkc->wtfc", np.stack(local).astype(float), frame)
    added[:, :2] = 0.0
    return simulated + added


def _scaled(rows, scales):
    return tuple(jnp.asarray((r - mean) / std, jnp.float32) for r, (mean, std) in zip(rows, scales, strict=True))


def _config(windows: Windows, size: int) -> ModelConfig:
    nodes = windows.keypoints.shape[2] + 2
    return ModelConfig(
        n_keypoints=nodes, length=1.0, radius=_REACH / (nodes - 1), latent=size, hidden=size, hidden_layers=1,
        message_passing=_PASSES,
    )  # fmt: skip


def _features(simulated, windows):
    """Features of nodes [W, T, N, n] and of edges [W, T, E, e]."""
    frame, position = moving_frame(windows), windows.position
    nodes = np.concatenate([position[:, :, :1], simulated, position[:, :, 1:]], axis=2)
    local = in_frame(nodes - position.mean(axis=2, keepdims=True), frame)
    lags = [max(1, round(t / windows.interval)) for t in _MOVED]
    moved = [in_frame(nodes - earlier(nodes, lag), frame) for lag in lags]
    arclength = np.concatenate([[0.0], windows.arclength])
    s = arclength / arclength[-1]
    place = np.stack([s, 4 * s * (1 - s), s == 0, s == 1], axis=-1)
    place = np.broadcast_to(place, (*nodes.shape[:3], 4))
    held = np.zeros_like(local)
    held[:, :, [0, -1]] = in_frame(windows.frames[:, :, :, 0], frame)
    topology = topology_of(_config(windows, 1))
    along = arclength[topology.receivers] - arclength[topology.senders]
    chord = local[:, :, topology.receivers] - local[:, :, topology.senders]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    far = np.broadcast_to(along[:, None], length.shape)
    edges = np.concatenate([chord, np.abs(far) - length, far], axis=-1)
    return [np.concatenate([local, *moved, place, held], axis=-1), edges]
