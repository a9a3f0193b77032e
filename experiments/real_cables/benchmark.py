"""Real cables by the protocol of Chen et al. (2024): windows of 500 frames, split by file or by recording."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.protocol import Explanation
from cablejax.npz import read_npz
from cablejax.recordings.deform import NOMINAL, DeformRecordings
from cablejax.simulate.rod.clamps import frames_along
from cablejax.spatial.cable import errors, over_all_markers
from cablejax.spatial.estimate import estimates_of_halves
from cablejax.spatial.identify import Identified, identify
from cablejax.spatial.windows import Windows
from real_cables.network import fit_network
from real_cables.residual import fit_residual

# Quantile of a spacing over all samples that is taken for the arc length between two markers: where it is straight.
_STRAIGHT = 0.75
_JUMP = 0.002
_DRAWS = 5000
_LEARNED = ("rod", "rod + ridge", "rod + graph network", "rod + graph network + ridge")


def protocol_windows(recordings: DeformRecordings) -> Windows:
    """Every block as one window. Swapped pairs are put right; samples after a jump in time are not fitted nor scored by
    `Windows.valid`, but simulated through."""
    points = recordings.keypoints.copy()
    for outer, inner, third in ((0, 1, 2), (-1, -2, -3)):
        near, far = (np.linalg.norm(points[:, :, k] - points[:, :, third], axis=-1) for k in (outer, inner))
        swapped = (far > near)[:, :, None, None]
        pair = [outer, inner]
        points[:, :, pair] = np.where(swapped, points[:, :, pair[::-1]], points[:, :, pair])
    step = np.median(np.linalg.norm(np.diff(points, axis=1), axis=-1), axis=2)
    padded = np.pad(step, ((0, 0), (1, 1)))
    jump = step > 2 * np.maximum(padded[:, :-2], padded[:, 2:]) + _JUMP
    count = np.where(jump.any(axis=1), jump.argmax(axis=1) + 1, points.shape[1])
    tangent = np.stack([points[:, :, 1] - points[:, :, 0], points[:, :, -1] - points[:, :, -2]], axis=2)
    tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    spacing = np.linalg.norm(np.diff(points[recordings.split == "train"][:, ::5], axis=2), axis=-1)
    lengths = np.quantile(spacing.reshape(-1, spacing.shape[-1]), _STRAIGHT, axis=0)[1:-1]
    return Windows(
        keypoints=points[:, :, 2:-2],
        position=points[:, :, [1, -2]],
        frames=np.stack([frames_along(tangent[:, :, q]) for q in range(2)], axis=2),
        valid=np.arange(points.shape[1]) < count[:, None],
        interval=recordings.dt,
        episode=np.arange(len(points)),
        begin=np.zeros(len(points), int),
        group=recordings.recording,
        split=tuple(recordings.split),
        name=tuple(str(n) for n in recordings.source_id),
        held=(2, 2),
        arclength=np.cumsum(lengths),
        n_keypoints=points.shape[2],
    )


@dataclasses.dataclass(frozen=True)
class CableScore:
    """Errors of one cable, mean absolute coordinate error over all markers, held ones counted as 0 [mm].

    Attributes:
        stages: of the search (name, on recordings of the train split that the fit has not seen, on the eval split);
            both are means over the fits to either half of the recordings.
        learned: (name, split by recording, on the eval split, 5 and 95 % quantile over random choices of as many of all
            windows as eval has) of the rod with all effects and of what is learned on top of it.
        without_own: the rod on the eval split, its recordings' own values left at what all recordings share.
        simulated: EI / rho that either half of the recordings is simulated with [m^4/s^2].
        estimated: EI / rho of either half as `estimate` reports it, with its 90 % interval [m^4/s^2].
        seconds: of one 5 s rollout alone (median), and of a batch of all windows.
        effects: that were found.
        networks: size and rounds that were chosen for the graph network of all, and of either half.
    """

    stages: tuple[tuple[str, float, float], ...]
    learned: tuple[tuple[str, float, float, float, float], ...]
    without_own: float
    simulated: tuple[float, ...]
    estimated: tuple[tuple[float, float, float], ...]
    seconds: tuple[float, float]
    effects: tuple[str, ...]
    networks: tuple[tuple[int, int], ...]


def score_cable(recordings: DeformRecordings, *, state: pathlib.Path, progress: Callable[[str], None]) -> CableScore:
    """Identifies a cable on upstream's train split and scores every stage, the eval split only at the very end.

    Args:
        recordings: of the cable.
        state: folder that keeps what is done, so that an interrupted call goes on where it was.
        progress: called with a line of text.
    """
    windows = protocol_windows(recordings)
    split = np.array(windows.split)
    train, kept = (windows.chosen(np.flatnonzero(split == name)) for name in ("train", "eval"))
    nominal = NOMINAL.bending_stiffness / NOMINAL.linear_density
    found = identify(train, nominal, state=state / f"{recordings.name}_search.json", progress=progress)
    # scored as published: every frame, whatever was lost in between
    whole = dataclasses.replace(kept, valid=np.ones_like(kept.valid))

    by_recording = {name: np.zeros_like(train.keypoints) for name in _LEARNED}
    networks = []
    for k, one in enumerate(found.halves):
        half = found.first if k == 0 else ~found.first
        part, other = (train.chosen(np.flatnonzero(use)) for use in (half, ~half))
        # a recording that is not seen has no values of its own; nor have those that its corrections are learned from
        fitted, unseen = (found.cable.on(w).motion(shared_only(one)) for w in (part, other))
        progress(f"learning corrections, half {k + 1}")
        path = state / f"{recordings.name}_half{k + 1}.npz"
        corrected, network = _learned(fitted, part, unseen, other, path, progress)
        networks.append(network)
        for name, predicted in corrected.items():
            by_recording[name][~half] = predicted
    on_whole = found.cable.on(whole)
    final = on_whole.motion(found.everything)
    progress("learning corrections, all of train")
    path = state / f"{recordings.name}_all.npz"
    on_eval, network = _learned(found.cable.motion(found.everything), train, final, whole, path, progress)

    def metric(predicted, of) -> Float[np.ndarray, "W"]:
        return 1e3 * over_all_markers(errors(predicted, of), of)

    stages, share = [], train.keypoints.shape[2] / train.n_keypoints
    for step in found.steps:
        if step.accepted:
            scored = [metric(on_whole.motion(one), whole).mean() for one in step.halves]
            name = f"+ {step.effect}" if step.effect else "nominal"
            stages.append((name, 1e3 * share * float(step.error.mean()), float(np.mean(scored))))
    learned, draws = [], np.random.default_rng(0)
    for name in _LEARNED:
        unseen, scored = metric(by_recording[name], train), metric(on_eval[name], whole)
        everything = np.concatenate([unseen, scored])
        means = [draws.choice(everything, len(kept), replace=False).mean() for _ in range(_DRAWS)]
        low, high = np.quantile(means, [0.05, 0.95])
        learned.append((name, float(unseen.mean()), float(scored.mean()), float(low), float(high)))
    return CableScore(
        stages=tuple(stages),
        learned=tuple(learned),
        without_own=float(metric(on_whole.motion(shared_only(found.everything)), whole).mean()),
        simulated=tuple(found.stiffness(one) for one in found.halves),
        estimated=tuple(dataclasses.astuple(half.stiffness) for half in estimates_of_halves(found, progress=progress)),
        seconds=_seconds(found, windows),
        effects=found.effects,
        networks=(network, *networks),
    )


def shared_only(one: Explanation) -> Explanation:
    """Without what single recordings have for their own."""
    return one.moved(one.z, np.zeros_like(one.own))


def _learned(fitted, windows: Windows, simulated, others: Windows, path: pathlib.Path, progress):
    """Predictions of `others` with what is learned on `windows`, by name, and the network's size and rounds."""
    if not path.exists():
        network = fit_network(fitted, windows, progress=progress)
        on_top = fit_residual(network.left_out, windows)
        with_network = network.correct(simulated, others)
        arrays = (
            simulated,
            fit_residual(fitted, windows).correct(simulated, others),
            with_network,
            on_top.correct(with_network, others),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        np.savez(partial, network=(network.size, network.rounds), **dict(zip(_LEARNED, arrays, strict=True)))
        partial.replace(path)
    kept = read_npz(path, ["network", *_LEARNED])
    return {name: kept[name] for name in _LEARNED}, (int(kept["network"][0]), int(kept["network"][1]))


def _seconds(found: Identified, windows: Windows) -> tuple[float, float]:
    times = []
    for index in ([0], np.arange(len(windows))):
        part = windows.chosen(index)
        repeats = []
        for _ in range(5):
            begun = time.perf_counter()
            found.cable.on(part).motion(found.everything)
            repeats.append(time.perf_counter() - begun)
        times.append(float(np.median(repeats)))
    return times[0], times[1]
