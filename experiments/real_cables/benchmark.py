"""Scores real cables: split by recording, and on upstream's eval split where there is one."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import pathlib
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from cablejax.diagnose.protocol import Explanation
from cablejax.npz import NpzError, read_npz
from cablejax.recordings.deform import NOMINAL, DeformRecordings
from cablejax.spatial.accidents import moderated, off
from cablejax.spatial.cable import errors
from cablejax.spatial.identify import Identified, identify
from cablejax.spatial.windows import Windows
from cablejax.whole_file import whole_file
from real_cables import features, network, residual
from real_cables.network import fit_network
from real_cables.protocol import protocol_windows
from real_cables.residual import fit_residual

_DRAWS = 5000
_LEARNED = ("rod", "rod + ridge", "rod + graph network", "rod + graph network + ridge")
_CARRIED, _RIDGE = "no simulator: its first shape, carried by the grippers", "no simulator: the same ridge on that"


@dataclasses.dataclass(frozen=True)
class Errors:
    """Of some windows: mean absolute error of a coordinate over all markers, held ones counted as 0.

    Attributes:
        mean: over windows, none counted as more than ten times the median (`accidents.moderated`) [mm].
        plain: over windows as they are; what a simulation has lost is off by a metre [mm].
        lost: number of windows that could not be simulated to their end.
        off: number of windows that were lost or are off by more than ten times the median.
        windows: their number.
    """

    mean: float
    plain: float
    lost: int
    off: int
    windows: int


@dataclasses.dataclass(frozen=True)
class CableScore:
    """Errors of one cable. What is of upstream's eval split is None where the recordings have none.

    Attributes:
        stages: of the search (name, on recordings that the fit has not seen, on the eval split) [mm]; both are means
            over the fits to either half of the recordings.
        learned: (name, split by recording, on the eval split, 5 and 95 % quantile over draws with replacement of as
            many of all windows as eval has [mm]) of the rod with all effects and of what is learned on top of it.
        unsimulated: likewise without a simulator, and without the spread: nothing clever, and what is learned on it.
        without_own: the rod on the eval split, its recordings' own values left at what all recordings share.
        estimated: EI / rho from either half of the recordings, with its 90 % interval [m^4/s^2].
        seconds: of one rollout alone (median), and of a batch of all windows.
        length: of a window [s].
        left_out: blocks that do not begin with two samples of all markers.
        effects: that were found.
        networks: size and rounds that were chosen for the graph network of all (where there is an eval split), and of
            either half.
    """

    stages: tuple[tuple[str, float, float | None], ...]
    learned: tuple[tuple[str, Errors, Errors | None, tuple[float, float] | None], ...]
    unsimulated: tuple[tuple[str, Errors, Errors | None], ...]
    without_own: Errors | None
    estimated: tuple[tuple[float, float, float], ...]
    seconds: tuple[float, float]
    length: float
    left_out: tuple[str, ...]
    effects: tuple[str, ...]
    networks: tuple[tuple[int, int], ...]


def score_cable(recordings: DeformRecordings, *, state: pathlib.Path, progress: Callable[[str], None]) -> CableScore:
    """Identifies a cable on all but upstream's eval split and scores every stage, the eval split only at the very end.

    Args:
        recordings: of the cable.
        state: folder that keeps what is done, so that an interrupted call goes on where it was.
        progress: called with a line of text.
    """
    windows = protocol_windows(recordings)
    is_eval = np.array(windows.split) == "eval"
    is_eval &= not is_eval.all()
    train = windows.chosen(np.flatnonzero(~is_eval))
    nominal = NOMINAL.stiffness_over_density
    found = identify(train, nominal, state=state / f"{recordings.name}_search.json", progress=progress)
    by_recording, networks = _by_recording(found, train, state / recordings.name, progress)
    # scored as published: every frame, whatever was lost in between
    kept = windows.chosen(np.flatnonzero(is_eval))
    kept = dataclasses.replace(kept, valid=np.ones_like(kept.valid)) if is_eval.any() else None
    on_eval, without_own = {}, None
    if kept is not None:
        on_kept = found.cable.on(kept)
        progress("learning corrections, all recordings")
        path = state / f"{recordings.name}_all.npz"
        everything = found.everything.explanation
        simulated, final = found.cable.motion(everything), on_kept.motion(everything)
        on_eval, chosen = _learned(simulated, train, final, kept, path, progress)
        networks = [chosen, *networks]
        without_own = errors_of(on_kept.motion(shared_only(everything)), kept)

    stages = []
    for step in found.steps:
        if step.accepted:
            name = f"+ {step.effect}" if step.effect else "nominal"
            scored = None
            if kept is not None:
                scored = float(np.mean([errors_of(found.cable.on(kept).motion(h), kept).mean for h in step.halves]))
            stages.append((name, errors_of(found.unseen_by(*step.halves)[0], train).mean, scored))
    learned = []
    for name in _LEARNED:
        scored, spread = None, None
        if kept is not None:
            scored = errors_of(on_eval[name], kept)
            spread = spread_of(np.append(_metric(by_recording[name], train), _metric(on_eval[name], kept)), len(kept))
        learned.append((name, errors_of(by_recording[name], train), scored, spread))
    return CableScore(
        stages=tuple(stages),
        learned=tuple(learned),
        unsimulated=_unsimulated(train, found.first, kept),
        without_own=without_own,
        estimated=tuple(dataclasses.astuple(half.stiffness) for half in found.halves),
        seconds=_seconds(found, windows),
        length=windows.keypoints.shape[1] * windows.interval,
        left_out=windows.left_out,
        effects=found.effects,
        networks=tuple(networks),
    )


def _unsimulated(
    train: Windows, first: Bool[np.ndarray, "W"], kept: Windows | None
) -> tuple[tuple[str, Errors, Errors | None], ...]:
    """Errors of cables that only move as their grippers do, and with a ridge regression on the grippers' history."""
    still, corrected = carried(train), np.zeros_like(train.keypoints)
    for seen in (first, ~first):
        part, other = (train.chosen(np.flatnonzero(use)) for use in (seen, ~seen))
        corrected[~seen] = fit_residual(still[seen], part).correct(still[~seen], other)
    on_eval: list[Errors | None] = [None, None]
    if kept is not None:
        shapes = carried(kept)
        learned = fit_residual(still, train).correct(shapes, kept)
        on_eval = [errors_of(shapes, kept), errors_of(learned, kept)]
    by_recording = [errors_of(still, train), errors_of(corrected, train)]
    return tuple(zip((_CARRIED, _RIDGE), by_recording, on_eval, strict=True))


def carried(windows: Windows) -> Float[np.ndarray, "W T F 3"]:
    """The free markers as they were at the second sample, in the frame that moves with the clamps [m]."""
    frame, middle = features.moving_frame(windows), windows.position.mean(axis=2, keepdims=True)
    first = features.in_frame(windows.keypoints[:, 1:2] - middle[:, 1:2], frame[:, 1:2])
    return np.einsum("wmk,wtkc->wtmc", first[:, 0], frame) + middle


def _by_recording(found: Identified, train: Windows, path: pathlib.Path, progress):
    """Predictions of every window from the half of the recordings that it is not part of, by name, and networks."""
    by_recording, networks = {name: np.zeros_like(train.keypoints) for name in _LEARNED}, []
    for k, half in enumerate(found.halves):
        seen = found.first if k == 0 else ~found.first
        part, other = (train.chosen(np.flatnonzero(use)) for use in (seen, ~seen))
        one = half.explanation
        # a recording that is not seen has no values of its own; nor have those that its corrections are learned from
        fitted, unseen = (found.cable.on(w).motion(shared_only(one)) for w in (part, other))
        progress(f"learning corrections, half {k + 1}")
        file = path.with_name(f"{path.name}_half{k + 1}.npz")
        corrected, chosen = _learned(fitted, part, unseen, other, file, progress)
        networks.append(chosen)
        for name, predicted in corrected.items():
            by_recording[name][~seen] = predicted
    return by_recording, networks


def _metric(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Float[np.ndarray, "W"]:
    # the held markers count as predicted without error, as Chen et al. (2024) count
    return 1e3 * errors(predicted, windows) * windows.keypoints.shape[2] / windows.n_keypoints


def errors_of(predicted: Float[np.ndarray, "W T F 3"], windows: Windows) -> Errors:
    """Errors of predictions [m] of windows."""
    each, seen = _metric(predicted, windows), np.isfinite(windows.observed)
    lost = (seen & ~np.isfinite(predicted)).any(axis=(1, 2, 3))
    return Errors(
        float(moderated(each).mean()), float(each.mean()), int(lost.sum()), int((lost | off(each)).sum()), len(each)
    )


def spread_of(each: Float[np.ndarray, "W"], count: int) -> tuple[float, float]:
    """5 and 95 % quantile of the moderated mean over so many windows, drawn with replacement as upstream does."""
    draws = np.random.default_rng(0).integers(len(each), size=(_DRAWS, count))
    low, high = np.quantile(moderated(each)[draws].mean(axis=1), [0.05, 0.95])
    return float(low), float(high)


def shared_only(one: Explanation) -> Explanation:
    """Without what single recordings have for their own."""
    return one.moved(one.z, np.zeros_like(one.own))


def _learned(fitted, windows: Windows, simulated, others: Windows, path: pathlib.Path, progress):
    """Predictions of `others` with what is learned on `windows`, by name, and the network's size and rounds."""
    made_from = learned_from(fitted, windows, simulated, others)
    kept = _kept(path)
    if kept is None or str(kept["fingerprint"]) != made_from:
        trained = fit_network(fitted, windows, progress=progress)
        on_top = fit_residual(trained.left_out, windows)
        with_network = trained.correct(simulated, others)
        arrays = (
            simulated,
            fit_residual(fitted, windows).correct(simulated, others),
            with_network,
            on_top.correct(with_network, others),
        )
        kept = {"fingerprint": made_from, "network": np.array([trained.size, trained.rounds])}
        kept |= dict(zip(_LEARNED, arrays, strict=True))
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as stream:
            np.savez(stream, **kept)
    return {name: kept[name] for name in _LEARNED}, (int(kept["network"][0]), int(kept["network"][1]))


def _kept(path: pathlib.Path) -> dict[str, np.ndarray] | None:
    """What was learned before; None if there is nothing, or nothing that says what it was made from."""
    try:
        return read_npz(path, ["fingerprint", "network", *_LEARNED], text=["fingerprint"])
    except (NpzError, FileNotFoundError):
        return None


def learned_from(fitted, windows: Windows, simulated, others: Windows) -> str:
    """Fingerprint of all that learned corrections depend on: the simulation, the recordings, and how is learned."""
    digest = hashlib.sha256(repr((windows.interval, windows.held, windows.n_keypoints)).encode())
    for module in (network, residual, features):
        digest.update(inspect.getsource(module).encode())
    parts = [getattr(w, f) for w in (windows, others) for f in ("keypoints", "position", "frames", "valid", "group")]
    for array in (fitted, simulated, windows.arclength, *parts):
        digest.update(repr((array.shape, array.dtype.str)).encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _seconds(found: Identified, windows: Windows) -> tuple[float, float]:
    times = []
    for index in ([0], np.arange(len(windows))):
        part = windows.chosen(index)
        repeats = []
        for _ in range(5):
            begun = time.perf_counter()
            found.cable.on(part).motion(found.everything.explanation)
            repeats.append(time.perf_counter() - begun)
        times.append(float(np.median(repeats)))
    return times[0], times[1]
