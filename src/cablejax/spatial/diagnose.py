"""The diagnosis of a cable in space: where the simulator is wrong on recorded motion, and which effects cause it."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from cablejax.diagnose.diagnosis import Diagnosis, Gap, NamedEffect, ParameterEstimate, Ranked, Verdict
from cablejax.diagnose.where import Where
from cablejax.report.effect_words import effect_title, listed, millimetres, share
from cablejax.spatial.effects import CURVATURE_KNOTS, PROFILE_KNOTS
from cablejax.spatial.geometry import LocalChange, local_changes
from cablejax.spatial.identify import EDGES, Identified, identify
from cablejax.spatial.search import resampled
from cablejax.spatial.windows import WINDOW, Windows, windows_of
from cablejax.types import GapLog

_NINETY = 1.645
# A gap up to so many times the noise is none; an explanation that leaves less than this share of the gap is complete.
_RESOLVABLE = 3.0
_COMPLETE = 0.25
_TELLING = 0.2


@dataclasses.dataclass(frozen=True)
class SpatialDiagnosis(Diagnosis):
    """A diagnosis in space. Arrays of keypoints have three coordinates; held keypoints are as observed.

    Attributes:
        changes: places and files where the set-up differs from the rest.
        identified: the simulator with the effects that were found.
        windows: that it was found from.
    """

    changes: tuple[LocalChange, ...]
    identified: Identified
    windows: Windows


def diagnose_space(
    log: GapLog,
    *,
    only: Sequence[str] | None = None,
    state: pathlib.Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> SpatialDiagnosis:
    """Diagnoses a log of a cable that hangs between two grippers and moves.

    Episodes whose `split` is "eval" are left untouched. Everything is told per mass, since the motion of a hanging
    cable does not depend on its weight.

    Args:
        log: in space.
        only: names of the effects to look for; by default all.
        state: file that keeps what is done; an interrupted diagnosis goes on from there.
        progress: called with a line of text.

    Raises:
        ValueError: a log that cannot be diagnosed, with the reason.
    """
    begun = time.perf_counter()
    windows = windows_of(log)
    left_out = sum(split == "eval" for split in windows.split)
    if left_out == len(windows):
        raise ValueError("All windows are of the eval split, which is not to be fitted: record or label others.")
    windows = windows.chosen([i for i, split in enumerate(windows.split) if split != "eval"])
    cable = log.meta["cable"]
    stiffness = cable["bending_stiffness_n_m2"] / cable["linear_density_kg_per_m"]
    progress(f"{len(windows)} windows of {WINDOW:g} s, {len(np.unique(windows.group))} recordings")
    changes = local_changes(log, windows.held)
    for change in changes:
        progress(change.sentence)
    found = identify(windows, stiffness, only=only, state=state, progress=progress)

    nothing = np.zeros(found.simulator.layout.size)
    before = found.simulator.predict(nothing, windows)
    after = found.unseen(windows)
    noise = noise_of(windows)
    gap = _gap(before, after, windows, noise)
    verdict = _verdict(gap, found)
    effects = () if verdict in ("none", "unknown") else _named(found, cable["linear_density_kg_per_m"], windows)
    nominal, explained = (_in_log(log, windows, part) for part in (before, after))
    where = _where(log, windows, nominal, before, noise, changes)
    return SpatialDiagnosis(
        verdict=verdict,
        sentence=_sentence(verdict, gap, effects, changes),
        effects=effects,
        equivalent=_equivalent(found),
        ranking=_ranking(found),
        leftover_p=None,
        gap=gap,
        where=where,
        next_motion=None,
        baselines={},
        caveats=_caveats(log, windows, left_out, found),
        log=log,
        nominal=nominal,
        explained=explained,
        noise_mm=np.full(windows.n_keypoints, 1e3 * noise),
        noise_correlation=np.zeros(0),
        seconds=time.perf_counter() - begun,
        settings={"edges": EDGES, "window_s": WINDOW, "jax": jax.__version__, "devices": jax.default_backend()},
        changes=changes,
        identified=found,
        windows=windows,
    )


def noise_of(windows: Windows) -> float:
    """Standard deviation of a coordinate [m], from fourth differences in time, which no motion of a cable has."""
    fourth = np.diff(windows.keypoints, n=4, axis=1)
    fourth = fourth[(windows.valid[:, 4:]) & np.isfinite(fourth).all(axis=(2, 3))]
    return float(1.4826 * np.median(np.abs(fourth)) / np.sqrt(70)) if fourth.size else 0.0


def _squares(predicted, windows):
    """Squared errors of free coordinates, bounded by a metre, NaN where nothing was recorded."""
    off = np.minimum(np.nan_to_num(np.abs(predicted - windows.keypoints), nan=1.0, posinf=1.0), 1.0) ** 2
    seen = np.isfinite(windows.keypoints) & windows.valid[:, :, None, None]
    seen[:, :2] = False
    return np.where(seen, off, np.nan)


def _mean(values, axis):
    """Mean of what is finite; NaN where nothing is."""
    seen = np.isfinite(values)
    count = seen.sum(axis=axis)
    return np.where(count > 0, np.where(seen, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


def _gap(before, after, windows, noise) -> Gap:
    squared = [_squares(part, windows) for part in (before, after)]
    means = [np.nanmean(s) for s in squared]
    windowed = [_mean(s, (1, 2, 3)) for s in squared]
    resolvable = means[0] > (_RESOLVABLE * noise) ** 2
    shrinkage = float(1 - (means[1] - noise**2) / (means[0] - noise**2)) if resolvable else None
    interval = None
    if shrinkage is not None:
        one, other = (resampled(w, windows.group) for w in windowed)
        low, high = np.quantile(1 - other / one, [0.05, 0.95])
        interval = (float(low), float(high))
    horizons, count = {}, windows.valid.shape[1]
    for seconds in (1.0, 2.0, 5.0):
        end = min(round(seconds / windows.interval), count)
        horizons[seconds] = tuple(1e3 * float(np.sqrt(np.nanmean(s[:, :end]))) for s in squared)
    floor, left = float(noise**2 / means[0]), float(means[1] / means[0])
    return Gap(
        before_rmse_mm=1e3 * float(np.sqrt(means[0])),
        after_rmse_mm=1e3 * float(np.sqrt(means[1])),
        noise_floor_mm=1e3 * noise,
        shrinkage=shrinkage,
        shrinkage_ci90=interval,
        ahead_mm=None,
        horizons_mm=horizons,
        held_out_episodes=tuple(sorted({int(e) for e in windows.episode})),
        split={"noise": floor, "named": max(1 - left, 0.0), "learnable": 0.0, "unexplained": max(left - floor, 0.0)},
    )


def _verdict(gap: Gap, found: Identified) -> Verdict:
    if gap.shrinkage is None:
        return "none"
    if not found.effects or gap.shrinkage < _TELLING:
        return "unknown"
    if gap.after_rmse_mm > max(_COMPLETE * gap.before_rmse_mm, _RESOLVABLE * gap.noise_floor_mm):
        return "named+unknown"
    return "ambiguous" if _equivalent(found) else "named"


def _equivalent(found: Identified) -> tuple[tuple[str, ...], ...]:
    """Rest curvature and a stiffness profile that take each other's place equally well."""
    swap = next((s for s in found.steps if s.effect == "intrinsic_curvature for stiffness_profile"), None)
    kept = [s for s in found.steps if s.accepted and s.effect != "intrinsic_curvature"]
    if swap is None or swap.accepted or not kept or swap.chance < 0.05:
        return ()
    return (("stiffness_profile", "intrinsic_curvature"),) if "stiffness_profile" in found.effects else ()


def _ranking(found: Identified) -> tuple[Ranked, ...]:
    """Every effect tried, by the share of the nominal error that went when it came in, on unseen recordings."""
    nominal, before, ranked = found.steps[0].error, found.steps[0].error, []
    for step in found.steps[1:]:
        name = step.effect.split(" ")[0]
        gain = float((before**2).mean() - (step.error**2).mean()) / float((nominal**2).mean())
        chance = min(step.chance, 0.99) if step.accepted else min(step.chance, 0.84)
        ranked.append(Ranked(name, chance, gain, 1e3 * float(step.error.mean())))
        before = step.error if step.accepted else before
    unique: dict[str, Ranked] = {}
    for entry in ranked:
        if entry.name not in unique or entry.held_out_shrinkage > unique[entry.name].held_out_shrinkage:
            unique[entry.name] = entry
    return tuple(sorted(unique.values(), key=lambda r: -r.held_out_shrinkage))


def _named(found: Identified, density: float, windows: Windows) -> tuple[NamedEffect, ...]:
    layout = found.simulator.layout
    halves = np.stack([values.shared for values in found.half_values])
    spread = np.maximum(found.spread, np.abs(halves[0] - halves[1]) / 2)
    part = {f: (found.values.shared[s], spread[s]) for f, s in layout.slices.items()}
    length = layout.arclength[-1]
    profile, wobble = part["log_profile"]
    chance = {step.effect: step.chance for step in found.steps}
    named = []

    def estimate(value, error, unit):
        return ParameterEstimate(float(value), (float(value - _NINETY * error), float(value + _NINETY * error)), unit)

    def ratio(log, error):
        ends = np.exp([log - _NINETY * error, log + _NINETY * error])
        return ParameterEstimate(float(np.exp(log)), (float(ends[0]), float(ends[1])), "")

    def place(knot, knots):
        half = 0.5 * length / (knots - 1)
        centre = knot * length / (knots - 1)
        return centre, [max(centre - half, 0.0), min(centre + half, length)]

    for name in found.effects:
        location: dict = {"along_cable_m": None, "time_s": None, "table_m": None}
        if name == "bending_stiffness":
            whole = layout.log_stiffness(halves)
            error = np.sqrt((layout.log_stiffness(found.moves[2]) ** 2).sum())
            value, error = layout.log_stiffness(found.values.shared), max(error, abs(whole[0] - whole[1]) / 2)
            parameters = {"ratio": ratio(value, error)}
        elif name == "stiffness_profile":
            knot = int(np.abs(profile - profile.mean()).argmax())
            centre, along = place(knot, PROFILE_KNOTS)
            rest = np.delete(profile, knot).mean()
            parameters = {
                "centre_m": ParameterEstimate(centre, None, "m"),
                "width_m": ParameterEstimate(along[1] - along[0], None, "m"),
                "ratio": ratio(profile[knot] - rest, wobble[knot]),
            }
            location["along_cable_m"] = along
        elif name == "bending_damping":
            parameters = {"time_s": estimate(part["damping_time"][0][0], part["damping_time"][1][0], "s")}
        elif name == "viscous_drag":
            value, error = (density * x[0] for x in part["drag"])
            parameters = {"coefficient_n_s_per_m2": estimate(value, error, "N s/m²")}
        elif name == "quadratic_drag":
            value, error = (x[0] for x in part["quadratic_drag"])
            parameters = {"coefficient_per_m": estimate(value, error, "1/m")}
        elif name == "lumped_mass":
            value, error = (density * x[0] for x in part["marker_mass"])
            parameters = {"mass_kg": estimate(value, error, "kg")}
        elif name == "gripper_rotation_offset":
            angle, error = (x.reshape(2, 2) for x in part["clamp_rotation"])
            size, wide = np.linalg.norm(angle, axis=1), error.max(axis=1)
            parameters = {
                "gripper": ParameterEstimate([0, 1], None, ""),
                "angle_rad": ParameterEstimate(
                    size.tolist(),
                    [(float(max(a - _NINETY * e, 0)), float(a + _NINETY * e)) for a, e in zip(size, wide, strict=True)],
                    "rad",
                ),
            }
        elif name == "keypoint_bias":
            offset, error = part["along"]
            index = np.flatnonzero(np.abs(offset) > np.maximum(_NINETY * error, 1e-3))
            parameters = {
                "index": ParameterEstimate([int(i) + windows.held[0] for i in index], None, ""),
                "offset_m": ParameterEstimate(
                    offset[index].tolist(),
                    [(float(offset[i] - _NINETY * error[i]), float(offset[i] + _NINETY * error[i])) for i in index],
                    "m",
                ),
            }
        else:
            curvature, error = (x.reshape(-1, 2) for x in part["rest_curvature"])
            knot = int(np.linalg.norm(curvature, axis=1).argmax())
            centre, along = place(knot, CURVATURE_KNOTS)
            parameters = {
                "centre_m": ParameterEstimate(centre, None, "m"),
                "width_m": ParameterEstimate(along[1] - along[0], None, "m"),
                "curvature_per_m": estimate(np.linalg.norm(curvature[knot]), error[knot].max(), "1/m"),
            }
            location["along_cable_m"] = along
        named.append(NamedEffect(name, min(chance.get(name, 0.9), 0.99), parameters, location))
    return tuple(named)


def _in_log(log, windows, predicted) -> Float[np.ndarray, "E T N 3"]:
    """Predictions at the log's samples; held keypoints as observed, NaN where nothing was predicted."""
    points = np.full(log.keypoints.shape, np.nan)
    first, last = windows.held[0], windows.n_keypoints - windows.held[1]
    for e, begin, valid, part in zip(windows.episode, windows.begin, windows.valid, predicted, strict=True):
        count = int(valid.sum())
        points[e, begin : begin + count] = log.keypoints[e, begin : begin + count]
        points[e, begin : begin + count, first:last] = part[:count]
    return points


def _where(log, windows, nominal, before, noise, changes) -> Where:
    off = np.minimum(np.abs(np.asarray(log.keypoints, float) - nominal), 1.0)
    squares = _squares(before, windows)
    level = max(noise, 1e-6)
    along = 1e3 * np.sqrt(np.nan_to_num(_mean(off**2, (0, 1, 3))))
    episodes = np.full(len(log.keypoints), np.nan)
    for e in np.unique(windows.episode):
        episodes[e] = 1e3 * float(np.sqrt(_mean(off[e] ** 2, None)))
    arclength = log.meta["keypoint_arclength_m"]
    speed = np.linalg.norm(np.diff(windows.position, axis=1, prepend=windows.position[:, :1]), axis=-1).max(axis=2)
    fast = (speed > np.median(speed[windows.valid]))[..., None, None] & np.isfinite(squares)
    regimes = {
        "speed: fast": 1e3 * float(np.sqrt(squares[fast].mean())),
        "speed: slow": 1e3 * float(np.sqrt(squares[~fast & np.isfinite(squares)].mean())),
    }
    worst = int(np.nanargmax(episodes))
    names = log.meta.get("file", log.meta.get("take", list(range(len(episodes)))))
    sentences = [change.sentence for change in changes]
    sentences += [
        f"The gap is largest at keypoint {int(along.argmax())}, {arclength[int(along.argmax())]:.2f} m along the "
        f"cable: {millimetres(along.max())}. A cable held at both ends deviates most in its middle whatever the cause.",
        f"The worst file is {names[worst]} with {millimetres(episodes[worst])}; the median file has "
        f"{millimetres(np.nanmedian(episodes))}.",
        f"While the grippers move fast the gap is {millimetres(regimes['speed: fast'])}, slowly "
        f"{millimetres(regimes['speed: slow'])}.",
    ]
    count = squares.shape[1]
    horizons = {
        s: 1e3 * float(np.sqrt(np.nanmean(squares[:, : min(round(s / windows.interval), count)])))
        for s in (1.0, 2.0, 5.0)
    }
    missing = np.ones(len(episodes))
    return Where(
        gap_mm=1e3 * float(np.sqrt(np.nanmean(squares))),
        smallest_mm=1e3 * _RESOLVABLE * level,
        along_cable_mm=along,
        bend_per_m=np.zeros(len(along) - 2),
        per_episode_mm=episodes,
        episode_p=np.where(episodes > 1e3 * _RESOLVABLE * level, 0.0, missing),
        keypoint_p=np.where(along > 1e3 * _RESOLVABLE * level, 0.0, 1.0),
        heat=np.sqrt(_mean(off**2, -1)) / level,
        horizons_mm=horizons,
        regimes=regimes,
        frames={},
        contrasts={},
        regime_masks={},
        sentences=tuple(sentences),
    )


def _sentence(verdict, gap, effects, changes) -> str:
    if verdict == "none":
        text = "The simulator reproduces the recorded motion to within the noise."
    elif not effects:
        text = "None of the effects tried explains the gap."
    else:
        names = listed([effect_title(e.name) for e in effects])
        gone = f"explain {share(gap.shrinkage)} of the squared gap on recordings no fit has seen"
        left = f"; {millimetres(gap.after_rmse_mm)} are left without a cause." if "unknown" in verdict else "."
        text = f"{names[0].upper()}{names[1:]} {gone}{left}"
    return f"{text} {changes[0].sentence}" if changes else text


def _caveats(log, windows, left_out, found) -> tuple[str, ...]:
    result = [
        "The motion of a hanging cable does not depend on its weight: stiffness, drag and added masses are known "
        "relative to the linear density only, and a wrong density (linear_density) cannot be seen.",
        "A camera that lags would shift keypoints and grippers alike, for both come from the same marks: camera_lag "
        "cannot be seen.",
        "Roll of the grippers about the cable is not observed; it is taken as the least turn from their mean "
        "direction.",
    ]
    if "gripper_rotation_offset" in found.effects:
        own = found.values.own[:, found.simulator.layout.slices["clamp_rotation"]]
        result.append(
            "How the cable sits in the grippers is fitted for each recording: it differs by "
            f"{np.sqrt((own**2).mean()):.2f} rad (root mean square) from the mean that is named. Recordings that no "
            "fit has seen are predicted with the mean."
        )
    if left_out:
        result.append(f"{left_out} windows are labelled eval; nothing was fitted to or scored on them.")
    groups = len(np.unique(windows.group))
    if groups < 6:
        result.append(f"Only {groups} recordings: intervals over recordings are rough.")
    return tuple(result)
