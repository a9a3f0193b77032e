"""Real cables by the protocol of Chen et al. (2024): windows of 500 frames, split by file or by recording."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cablejax.recordings.deform import NOMINAL, DeformRecordings
from cablejax.spatial.fit import errors, over_all_markers
from cablejax.spatial.identify import Identified, identify
from cablejax.spatial.residual import fit_residual
from cablejax.spatial.rod import frames_along
from cablejax.spatial.windows import Windows

# Quantile of a spacing over all samples that is taken for the arc length between two markers: where it is straight.
_STRAIGHT = 0.75
_JUMP = 0.002
_DRAWS = 5000


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
        stages: (name, on recordings of the train split that the fit has not seen, on the eval split).
        by_recording: final simulator, and with the residual, from the half of the recordings that a window is not in.
        spread: 5, 50 and 95 % quantile over random choices of 14 of all windows, final with residual.
        halves: EI / rho from either half of the recordings [m^4/s^2].
        seconds: of one 5 s rollout alone (median), and of a batch of all windows.
        effects: that were found.
    """

    stages: tuple[tuple[str, float, float], ...]
    by_recording: tuple[float, float]
    spread: tuple[float, float, float]
    halves: tuple[float, float]
    seconds: tuple[float, float]
    effects: tuple[str, ...]


def score_cable(
    recordings: DeformRecordings, *, state: pathlib.Path | None, progress: Callable[[str], None]
) -> CableScore:
    """Identifies a cable on upstream's train split and scores every stage, the eval split only at the very end."""
    windows = protocol_windows(recordings)
    split = np.array(windows.split)
    train, kept = (windows.chosen(np.flatnonzero(split == name)) for name in ("train", "eval"))
    found = identify(train, NOMINAL.bending_stiffness / NOMINAL.linear_density, state=state, progress=progress)
    simulator = found.simulator
    fitted, unseen = simulator.predict(found.values, train), found.unseen(train)
    residual = fit_residual(fitted, train)
    corrected = np.empty_like(unseen)
    for half in (found.first, ~found.first):
        other = np.flatnonzero(~half)
        learned = fit_residual(unseen[other], train.chosen(other))
        corrected[half] = learned.correct(unseen[half], train.chosen(np.flatnonzero(half)))

    def metric(predicted, of=None) -> Float[np.ndarray, "W"]:
        of = train if of is None else of
        return 1e3 * over_all_markers(errors(predicted, of), of)

    # scored as published: every frame, whatever was lost in between
    whole = dataclasses.replace(kept, valid=np.ones_like(kept.valid))
    stages, share = [], train.keypoints.shape[2] / train.n_keypoints
    for step in found.steps:
        if step.accepted:
            on_eval = metric(simulator.predict(step.values.mean(axis=0), whole), whole).mean()
            name = f"+ {step.effect}" if step.effect else "nominal"
            stages.append((name, 1e3 * share * float(step.error.mean()), float(on_eval)))
    final = simulator.predict(found.values, whole)
    stages.append(
        ("all effects, fitted to all of train", float(metric(unseen).mean()), float(metric(final, whole).mean()))
    )
    kept_residual = metric(residual.correct(final, whole), whole)
    stages.append(("+ ridge residual", float(metric(corrected).mean()), float(kept_residual.mean())))

    everything = np.concatenate([metric(corrected), kept_residual])
    draws = np.random.default_rng(0)
    means = [draws.choice(everything, len(kept), replace=False).mean() for _ in range(_DRAWS)]
    return CableScore(
        stages=tuple(stages),
        by_recording=(float(metric(unseen).mean()), float(metric(corrected).mean())),
        spread=tuple(float(q) for q in np.quantile(means, [0.05, 0.5, 0.95])),  # pyright: ignore[reportArgumentType]
        halves=_stiffness(found),
        seconds=_seconds(found, windows),
        effects=found.effects,
    )


def _stiffness(found: Identified) -> tuple[float, float]:
    layout = found.simulator.layout
    log = found.half_values[:, layout.slices["log_stiffness"]].sum(axis=1)
    one, other = layout.nominal_stiffness * np.exp(
        log + found.half_values[:, layout.slices["log_profile"]].mean(axis=1)
    )
    return float(one), float(other)


def _seconds(found: Identified, windows: Windows) -> tuple[float, float]:
    times = []
    for index in ([0], np.arange(len(windows))):
        part = windows.chosen(index)
        repeats = []
        for _ in range(5):
            begun = time.perf_counter()
            found.simulator.predict(found.values, part)
            repeats.append(time.perf_counter() - begun)
        times.append(float(np.median(repeats)))
    return times[0], times[1]
