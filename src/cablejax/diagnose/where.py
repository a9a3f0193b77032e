"""Localises the gap: along the cable, by episode, in time, by regime and by frame.

Looks at the open-loop residual only, observed less nominal keypoints over whole episodes, and at no explanation of it.
Every size is a root mean square per coordinate with the noise taken out, `sqrt(max(ms - sigma^2, 0))`.

Two kinds of test, since each sees what the other cannot. Against the noise floor, episode by episode: a chi-square test
of the whitened residuals, corrected for their correlation in time and by Holm (1979) for the number of episodes.
Between parts of the cable and between regimes: signs of per-episode contrasts are flipped together (episodes are the
independent unit), and a contrast is held against the largest of all that are looked at (Westfall and Young 1993).
Flipping the signs of E episodes cannot give less than 2 / 2^E: fewer than 6 episodes never make a contrast significant.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float

from cablejax.arrays import mean_of_finite, quarter_turn
from cablejax.diagnose.clock import usual_interval
from cablejax.diagnose.evidence import repeated_motions
from cablejax.diagnose.regimes import Regimes, regimes_of
from cablejax.diagnose.significance import (
    LEVEL,
    NOISE_TOLERANCE,
    contrast_p,
    exceedance_p,
    smallest_gap,
    variance_inflation,
)
from cablejax.diagnose.where_words import describe
from cablejax.types import GapLog

HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
"""Seconds since an episode's start; the value at one is taken from the one before on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Where:
    """Sizes and places of the gap. All `_mm` are root mean squares per coordinate above the noise [mm].

    What was not computed is None, or empty where it is a collection.

    Attributes:
        gap_mm: over the whole log.
        smallest_mm: the least gap over the whole log that would have been distinguished from noise.
        along_cable_mm: at each keypoint, shape [N].
        bend_per_m: root mean square difference of the curvature at each inner keypoint, above the noise [1/m]. The gap
            itself is always small near the grippers, which hold the cable; this points closer to a cause that is local.
            Shape [N - 2]; None where it was not computed, as for cables off the table.
        per_episode_mm: shape [E].
        episode_p: of no gap in this episode, corrected for the number of episodes, shape [E]; None where it was not
            tested.
        keypoint_p: of no gap at this keypoint, corrected for the number of keypoints, shape [N]; None where it was not
            tested.
        heat: whitened gap, `sqrt(mean of two squared coordinates)` in noise units, NaN = not observed, shape [E, T, N].
        horizons_mm: by seconds since the episode's start, see `HORIZONS`.
        regimes: by "what: class", for example "speed: hold"; classes that a log does not visit are left out.
        frames: share of the squared gap that an error constant in one frame would explain: "body" (each keypoint
            displaced along and across the cable), "table" (each displaced in x and y), "image" (one similarity of the
            whole picture).
        along_share: share of the squared gap that lies along the cable, and not across it; None where it was not
            computed, or nothing is above the noise.
        contrasts: by name: (ratio of the two sizes, p-value corrected for the number of contrasts).
        regime_masks: which samples each regime holds, for drawing, shape [E, T] each.
        sentences: what stands out, in words.
    """

    gap_mm: float
    smallest_mm: float
    along_cable_mm: Float[np.ndarray, "N"]
    bend_per_m: Float[np.ndarray, "N2"] | None = None
    per_episode_mm: Float[np.ndarray, "E"]
    episode_p: Float[np.ndarray, "E"] | None = None
    keypoint_p: Float[np.ndarray, "N"] | None = None
    heat: Float[np.ndarray, "E T N"]
    horizons_mm: dict[float, float]
    regimes: dict[str, float]
    frames: dict[str, float] = dataclasses.field(default_factory=dict)
    along_share: float | None = None
    contrasts: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    regime_masks: dict[str, Bool[np.ndarray, "E T"]] = dataclasses.field(default_factory=dict)
    sentences: tuple[str, ...] = ()


def localise(log: GapLog, nominal: Float[np.ndarray, "E T N 2"], noise: Float[np.ndarray, "N"]) -> Where:
    """Localises the gap between a log and its nominal simulation.

    Args:
        log: of a cable on a table; keypoints may be missing, and so may the hold flags.
        nominal: simulated keypoints at the log's samples [m], NaN where there are none.
        noise: standard deviation of each keypoint's coordinates [m].

    Raises:
        ValueError: shapes that do not fit the log, a noise that is not positive, or nothing observed at all.
    """
    if nominal.shape != log.keypoints.shape or nominal.shape[-1] != 2:
        raise ValueError(f"nominal has shape {nominal.shape}, expected the planar log's {log.keypoints.shape}.")
    noise = np.broadcast_to(np.asarray(noise, np.float64), nominal.shape[2])
    if not (np.isfinite(noise) & (noise > 0)).all():
        raise ValueError(f"noise is {noise} m, expected positive finite standard deviations.")
    valid = log.valid
    residual = np.where(valid[..., None, None], log.keypoints.astype(np.float64) - nominal, np.nan)
    if not np.isfinite(residual).any():
        raise ValueError("No keypoint is both observed and simulated, so there is no gap to locate.")
    regimes = regimes_of(log, nominal, valid)
    pose = np.where(valid[..., None, None], log.gripper_pose, np.nan)
    interval = np.array([usual_interval(time[:n]) for time, n in zip(log.time, log.episode_length, strict=True)])
    motion = repeated_motions(pose, interval, float(log.meta["cable"]["length_m"]))
    arclength = np.asarray(log.meta["keypoint_arclength_m"], float)

    whitened = residual / noise[:, None]
    squared, squares = (whitened**2).mean(axis=-1), (residual**2).mean(axis=-1)
    everywhere = np.isfinite(squared)

    def size(mask) -> float:
        return float(np.nan_to_num(above(np.where(mask, squares, np.nan), noise)))

    inflation, parts = variance_inflation(whitened, log, regimes.hold), _along_and_across(residual, nominal)
    where = Where(
        gap_mm=size(True),
        smallest_mm=smallest_gap(noise, 2 * everywhere.sum() / inflation, LEVEL),
        along_cable_mm=above(squares, noise, (0, 1)),
        bend_per_m=_bending(log, residual, noise),
        per_episode_mm=above(squares, noise, (1, 2)),
        episode_p=exceedance_p(squared.reshape(len(squared), -1), inflation),
        keypoint_p=exceedance_p(squared.reshape(-1, squared.shape[-1]).T, inflation),
        heat=np.sqrt(squared),
        horizons_mm=_horizons(log, valid, size),
        regimes={name: size(mask[..., None]) for name, mask in regimes.masks.items()},
        frames=_frames(residual, noise, nominal, parts),
        along_share=_along_share(parts, noise),
        contrasts=_contrasts(squares, noise, size, regimes, motion, arclength),
        regime_masks=regimes.masks,
    )
    motions = len(np.unique(motion[everywhere.any(axis=(1, 2))]))
    sentences = describe(where, arclength, noise, motions=motions)
    return dataclasses.replace(where, sentences=sentences)


def sizes_of(
    squares: Float[np.ndarray, "E T N D"],
    noise: float,
    arclength: Float[np.ndarray, "N"],
    *,
    smallest_mm: float,
    names: Sequence[str],
    gap_mm: float | None = None,
    horizons_mm: Mapping[float, float] = MappingProxyType({}),
    regimes: Mapping[str, float] = MappingProxyType({}),
    first: Sequence[str] = (),
) -> Where:
    """Sizes along the cable and by episode, without tests, for cables off the table.

    Args:
        squares: squared errors of every coordinate [m^2], NaN = not observed.
        noise: standard deviation of a coordinate [m].
        arclength: of the keypoints [m].
        smallest_mm: the least gap that would have been seen.
        names: what to call each episode.
        gap_mm: over all that is compared, where that is not all of `squares`.
        horizons_mm: see `Where`.
        regimes: see `Where`.
        first: sentences that come before all others.
    """
    where = Where(
        gap_mm=float(above(squares, noise)) if gap_mm is None else gap_mm,
        smallest_mm=smallest_mm,
        along_cable_mm=above(squares, noise, (0, 1, 3)),
        per_episode_mm=above(squares, noise, (1, 2, 3)),
        heat=np.sqrt(mean_of_finite(squares, -1)) / max(noise, 1e-6),
        horizons_mm=dict(horizons_mm),
        regimes=dict(regimes),
    )
    found = describe(where, np.asarray(arclength), np.array([noise]), names)
    return dataclasses.replace(where, sentences=(*first, *found))


def above(squares: np.ndarray, noise: float | np.ndarray, axis: tuple[int, ...] | int | None = None) -> np.ndarray:
    """Root mean square above the noise [mm] of squared errors [m^2], NaN where none is finite."""
    return 1e3 * np.sqrt(np.maximum(mean_of_finite(squares - noise**2, axis), 0.0))


def _bending(log: GapLog, residual, noise) -> np.ndarray:
    """Root mean square difference of curvature above the noise [1/m], by divided differences across the cable."""
    spacing = np.diff(np.asarray(log.meta["keypoint_arclength_m"], np.float64))
    before, after = spacing[:-1], spacing[1:]
    weights = np.stack([after, -before - after, before]) * 2.0 / (before * after * (before + after))
    three = np.arange(len(before)) + np.arange(3)[:, None]
    second = np.einsum("kn,etknd->etnd", weights, residual[:, :, three])
    floor = ((weights * noise[three]) ** 2).sum(axis=0)
    seen = np.isfinite(second[..., 0])
    count = np.maximum(2 * seen.sum(axis=(0, 1)), 1)
    square = np.where(seen[..., None], second**2, 0.0).sum(axis=(0, 1, 3)) / count
    # across the cable only: twice the mean of both coordinates
    return np.sqrt(np.maximum(2 * (square - floor), 0.0) * (seen.any(axis=(0, 1))))


def _horizons(log: GapLog, valid, size) -> dict[float, float]:
    end = float(log.time[valid].max())
    result, before = {}, 0.0
    for horizon in HORIZONS:
        if before >= end:
            break
        mask = valid & (log.time > before) & (log.time <= horizon)
        if mask.any():
            result[horizon] = size(mask[..., None])
        before = horizon
    return result


def _along_and_across(residual, nominal) -> tuple[np.ndarray, np.ndarray]:
    """Parts of the residual along the simulated cable and across it [m], shape [E, T, N] each."""
    tangent = np.gradient(nominal, axis=2)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-12)
    return (residual * tangent).sum(axis=-1), (residual * quarter_turn(tangent)).sum(axis=-1)


def _along_share(parts, noise) -> float | None:
    """See `Where`, from `_along_and_across`."""
    along, across = (max(float(np.nanmean(part**2 - noise**2)), 0.0) for part in parts)
    return along / (along + across) if along + across > 0 else None


def _frames(residual, noise, nominal, parts) -> dict[str, float]:
    """Share of the squared gap that a constant error in each frame explains, noise taken out of both."""
    seen = np.isfinite(residual).all(axis=-1)
    floor = np.broadcast_to(noise**2, seen.shape)
    power = (np.where(seen[..., None], residual**2, 0.0)).sum() - 2 * floor[seen].sum()
    if power <= 2 * floor[seen].sum() * (NOISE_TOLERANCE - 1):
        return {}
    count = np.maximum(seen.sum(axis=(0, 1)), 1)

    def of_means(parts) -> float:
        explained = 0.0
        for part in parts:
            mean = np.where(seen, part, 0.0).sum(axis=(0, 1)) / count
            explained += float((count * mean**2).sum() - (noise**2).sum())
        return explained

    body = of_means(parts)
    table = of_means([residual[..., 0], residual[..., 1]])
    x, y = nominal[seen].T
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    design = np.concatenate([np.stack([x, -y, ones, zeros], axis=1), np.stack([y, x, zeros, ones], axis=1)])
    target = residual[seen].T.ravel()
    solution, *_ = np.linalg.lstsq(design, target, rcond=None)
    image = float(((design @ solution) ** 2).sum() - 4 * (noise**2).mean())
    return {
        name: float(np.clip(v / power, 0.0, 1.0)) for name, v in (("body", body), ("table", table), ("image", image))
    }


def _contrasts(squares, noise, size, regimes: Regimes, motion, arclength) -> dict[str, tuple[float, float]]:
    """Ratios of the gap in one part to that in its opposite, with p-values against the largest of all contrasts."""
    everywhere = np.isfinite(squares)
    pairs = {name: (a[..., None] & everywhere, b[..., None] & everywhere) for name, (a, b) in regimes.pairs.items()}
    third = arclength / arclength[-1]
    for name, part in (
        ("cable: first third", third < 1 / 3),
        ("cable: middle third", (third >= 1 / 3) & (third <= 2 / 3)),
        ("cable: last third", third > 2 / 3),
    ):
        pairs[name] = everywhere & part, everywhere & ~part
    floor = float((noise**2).mean())

    def logs(mask) -> np.ndarray:
        """Log of the square above the noise of each episode; bounded where it is all noise."""
        square = mean_of_finite(np.where(mask, squares - noise**2, np.nan), (1, 2))
        return np.log(np.maximum(square, 0.0) + 0.1 * floor)

    names, columns, ratios = [], [], []
    for name, (a, b) in pairs.items():
        both = a.any(axis=(1, 2)) & b.any(axis=(1, 2))
        if both.sum() < 2:
            continue
        names.append(name)
        columns.append(np.where(both, 0.5 * (logs(a) - logs(b)), np.nan))
        least = 0.1 * np.sqrt(floor) * 1e3
        ratios.append(max(size(a), least) / max(size(b), least))
    if not names:
        return {}
    p = contrast_p(np.stack(columns, axis=1), motion)
    return {name: (float(r), float(q)) for name, r, q in zip(names, ratios, p, strict=True)}
