"""`diagnose`: from a gap log to a verdict."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import time
from collections.abc import Callable, Sequence
from typing import get_args

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.actuation import Actuation, actuation
from cablejax.diagnose.belief import Calibration, excess, level
from cablejax.diagnose.conclude import Conclusion, baselines, conclude, sentence
from cablejax.diagnose.diagnosis import Diagnosis, Gap, NamedEffect, ParameterEstimate, Ranked, Verdict
from cablejax.diagnose.effects import LIBRARY, Context, Effect
from cablejax.diagnose.fit import Candidate, Evidence, Fit, candidate, evaluate, improve
from cablejax.diagnose.next_motion import next_motion
from cablejax.diagnose.noise import SMALLEST, NoiseFloor, noise_floor
from cablejax.diagnose.playback import Playback
from cablejax.diagnose.recording import DiagnosisError, Recording, prepare
from cablejax.diagnose.reference import predicted_ahead
from cablejax.diagnose.search import Search, search, without_one
from cablejax.diagnose.where import localise
from cablejax.simulate.config import CableConfig
from cablejax.simulate.replay import config_of_log
from cablejax.types import GapLog

FIT_LINKS = 33
"""Links of the cable in fits, which only need what an effect changes."""
FINE_LINKS = 65
"""Links of the nominal cable that the log is compared with."""
_HORIZONS = (1.0, 2.0, 5.0, 10.0)
_FOLD_STEPS = 2
_FOLDS = 6
# Nats that an effect must be worth on the other episodes to be used on one that no fit has seen.
_WORTH = 2.0


def _silent(text: str) -> None:
    del text


def diagnose(
    log: GapLog,
    *,
    effects: Sequence[Effect] = LIBRARY,
    commissioning: Sequence[GapLog] = (),
    calibration: Calibration = Calibration(),
    progress: Callable[[str], None] = _silent,
) -> Diagnosis:
    """Says where the nominal simulator is wrong on this log, which effect causes it, how far the gap shrinks with it.

    Args:
        log: of a cable on a table between two grippers; its `meta` states the cable and table believed in.
        effects: what to look for; `LIBRARY` and effects of your own.
        commissioning: logs known to have no effect: how far the simulator is off without any.
        calibration: constants of the judgement.
        progress: called with a line of text now and then.

    Raises:
        DiagnosisError: the log cannot be diagnosed; the message says why and what to do.
    """
    begin = time.perf_counter()
    if commissioning:
        calibration = dataclasses.replace(calibration, baseline=baseline_error(commissioning))
    case = _Case.of(log)
    recording = case.recording
    caveats = list(recording.caveats)
    if not commissioning:
        caveats.append(
            "No commissioning logs were given: the simulator's own error is not separated from the cable's gap; "
            f"{1e3 * calibration.baseline:.2g} mm of it is assumed."
        )
    if case.noise.std.max() <= SMALLEST:
        caveats.append(f"The keypoints carry no noise to speak of; {1e3 * SMALLEST:g} mm is assumed.")
    arms = case.arms
    evidence = case.evidence(calibration)
    null = evaluate(evidence, [candidate()])[0]
    gap = excess(float(null.sse.sum()), evidence)
    if gap > calibration.smallest_gap(level(evidence)):
        found = search(evidence, effects, case.context(), calibration, progress)
    else:
        found = Search((null,), np.zeros(1), {})
    conclusion = conclude(found, evidence, calibration)
    conclusion = _with_arms(conclusion, arms)

    progress("fitting without each episode in turn")
    explained, held_out = _explained(case, evidence, conclusion.best)
    reference = case.commanded_nominal if arms.deviates else case.nominal
    after = _after(case, conclusion, explained)
    measured = _gap(case, reference, after, held_out, conclusion.verdict)
    progress("looking for the next motion")
    rivals = [fit.candidate for fit in found.fits if fit.candidate.terms][:2]
    following = None
    if conclusion.verdict != "none" and rivals:
        following = next_motion(case.playback, rivals, case.noise.std)
    repaired = recording.as_log(log.meta)
    return Diagnosis(
        verdict=conclusion.verdict,
        sentence=sentence(conclusion),
        effects=conclusion.effects,
        equivalent=conclusion.equivalent,
        ranking=conclusion.ranking,
        gap=measured,
        where=localise(repaired, case.to_log(reference), case.noise.std),
        next_motion=following,
        baselines=baselines(found, evidence),
        caveats=tuple(caveats),
        log=repaired,
        nominal=case.to_log(reference),
        explained=None if conclusion.verdict == "none" else case.to_log(after),
        noise_mm=1e3 * case.noise.std,
        noise_correlation=case.noise.correlation,
        seconds=time.perf_counter() - begin,
        settings={
            "effects": [e.name for e in effects],
            "calibration": dataclasses.asdict(calibration),
            "links": {"fit": FIT_LINKS, "nominal": FINE_LINKS},
            **{p: importlib.metadata.version(p) for p in ("jax", "mujoco", "numpy")},
        },
    )


def baseline_error(logs: Sequence[GapLog]) -> float:
    """Root mean square error per coordinate above the noise [m] on logs without any effect."""
    squares = []
    for log in logs:
        case = _Case.of(log)
        evidence = case.evidence(Calibration())
        squares.append(excess(float(evaluate(evidence, [candidate()])[0].sse.sum()), evidence) ** 2)
    return max(float(np.sqrt(np.mean(squares))), 5e-5)


@dataclasses.dataclass(frozen=True)
class _Case:
    """A log, replayed nominally."""

    recording: Recording
    config: CableConfig
    arms: Actuation
    noise: NoiseFloor
    playback: Playback
    nominal: Float[np.ndarray, "E T N 2"]
    coarse: Float[np.ndarray, "E T N 2"]
    commanded_nominal: Float[np.ndarray, "E T N 2"]
    predicted_playback: Playback

    @classmethod
    def of(cls, log: GapLog) -> _Case:
        recording = prepare(log)
        noise = noise_floor(recording.keypoints, recording.hold)
        arms = actuation(
            recording.gripper_pose,
            recording.gripper_command if recording.has_commands else None,
            recording.interval,
            recording.length,
        )
        config = config_of_log(log, n_links=FIT_LINKS)
        first = _first_shapes(recording)

        def replay(n_links, pose):
            of_links = dataclasses.replace(config, n_links=n_links)
            try:
                return Playback.of_motion(of_links, pose, first, recording.interval)
            except ValueError as error:
                raise DiagnosisError(f"The nominal cable has no settled shape at a first pose: {error}") from error

        def run(playback):
            return playback.keypoints([playback.nominal()])[0].astype(np.float64)

        playback = replay(FIT_LINKS, recording.gripper_pose)
        nominal = run(replay(FINE_LINKS, recording.gripper_pose))
        if not np.isfinite(nominal).all():
            raise DiagnosisError("The nominal simulation of this log breaks down: are the poses continuous, in metres?")
        moved = arms.deviates
        return cls(
            recording=recording,
            config=config,
            arms=arms,
            noise=noise,
            playback=playback,
            nominal=nominal,
            coarse=run(playback),
            commanded_nominal=run(replay(FINE_LINKS, arms.commanded)) if moved else nominal,
            predicted_playback=replay(FIT_LINKS, arms.predicted) if moved else playback,
        )

    def evidence(self, calibration: Calibration) -> Evidence:
        observed = self.recording.keypoints
        target = observed - self.nominal + self.coarse
        bare = Evidence(self.playback, target, self.noise.std, temper=np.ones(len(target)), freedom=calibration.freedom)
        squares = (bare.residuals(self.coarse) ** 2).sum(axis=1)
        gap = level(bare) * np.sqrt(np.maximum(squares / np.maximum(bare.count, 1) - 1, 0.0))
        return dataclasses.replace(bare, temper=calibration.temper(gap, level(bare)))

    def context(self) -> Context:
        chord = np.diff(self.nominal, axis=2)
        turn = np.diff(np.arctan2(chord[..., 1], chord[..., 0]), axis=-1)
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        spacing = self.config.length / (self.config.n_keypoints - 1)
        return Context(
            config=self.config,
            keypoints=self.nominal,
            residual=self.recording.keypoints - self.nominal,
            duration=float((self.recording.interval * self.recording.length).min()),
            max_curvature=turn.max(axis=(1, 2)) / spacing,
        )

    def simulate(self, explanation: Candidate, episodes: Sequence[int] | None = None, *, predicted: bool = False):
        """Keypoints under an explanation, its discretisation error taken out."""
        playback = self.predicted_playback if predicted else self.playback
        chosen = slice(None) if episodes is None else list(episodes)
        physics = explanation.physics(playback.nominal(), self.config)
        return playback.keypoints([physics], episodes)[0] - self.coarse[chosen] + self.nominal[chosen]

    def to_log(self, keypoints):
        """NaN beyond an episode's end, and as long as the log."""
        valid = np.arange(keypoints.shape[1])[None] < self.recording.length[:, None]
        return np.where(valid[..., None, None], keypoints, np.nan)[:, : self.recording.length.max()]


def _first_shapes(recording: Recording) -> list[np.ndarray | None]:
    """Keypoints at the start of every episode, averaged over its first samples at rest; None where too few are seen."""
    shapes: list[np.ndarray | None] = []
    for points, pose in zip(recording.keypoints, recording.gripper_pose, strict=True):
        moved = np.abs(pose - pose[0]).max(axis=(1, 2)) > 1e-3
        still = points[: max(int(np.argmax(moved)) if moved.any() else len(points), 1)][:10]
        count = np.isfinite(still).sum(axis=0)
        mean = np.where(count > 0, np.nansum(still, axis=0) / np.maximum(count, 1), np.nan)
        shapes.append(mean if np.isfinite(mean).all(axis=1).sum() >= 3 else None)
    return shapes


def _with_arms(conclusion: Conclusion, arms: Actuation) -> Conclusion:
    """Adds what the encoders show to what the keypoints show."""
    if not arms.deviates:
        return conclusion
    named = tuple(
        NamedEffect(
            name=name,
            probability=0.99 if arms.explained else 0.7,
            parameters={key: ParameterEstimate(value, (float(ci[0]), float(ci[1])), unit)},
            location={"along_cable_m": None, "time_s": None, "table_m": None},
        )
        for name, (value, ci, unit) in arms.effects.items()
        for key in ("gain" if name == "actuation_gain" else "time_s",)
    )
    ranked = tuple(Ranked(e.name, e.probability, 1 - (arms.leftover / arms.deviation) ** 2, 0.0) for e in named)
    changed: dict[Verdict, Verdict] = {}
    if named and arms.explained:
        changed = {"none": "named", "unknown": "named+unknown"}
    elif named:
        changed = dict.fromkeys(get_args(Verdict), "named+unknown")
    else:
        changed = {"none": "unknown", "named": "named+unknown", "ambiguous": "named+unknown"}
    share = 1 - (arms.leftover / arms.deviation) ** 2
    return dataclasses.replace(
        conclusion,
        verdict=changed.get(conclusion.verdict, conclusion.verdict),
        effects=(*named, *conclusion.effects),
        ranking=(*ranked, *conclusion.ranking),
        explained=share if conclusion.verdict == "none" else conclusion.explained,
    )


def _explained(case: _Case, evidence: Evidence, best: Fit):
    """Keypoints of every episode from a fit that has not seen it, and which episodes could be held out.

    An effect that the other episodes do not show is left out: nothing would be known of it before this episode.
    """
    n_episodes = len(case.recording.length)
    if not best.candidate.terms or n_episodes == 1:
        return case.simulate(best.candidate), tuple(range(n_episodes)) if n_episodes > 1 else ()
    groups = [list(g) for g in np.array_split(np.arange(n_episodes), min(n_episodes, _FOLDS))]
    result = np.empty_like(case.nominal)
    for group in groups:
        rest = evidence.restricted([e for e in range(n_episodes) if e not in group])
        fits = evaluate(rest, [best.candidate, *without_one(best.candidate)])
        fit = improve(rest, fits[:1], max_iterations=_FOLD_STEPS)[0]
        simpler = min(fits[1:], key=lambda other: other.cost(rest))
        if simpler.cost(rest) < fits[0].cost(rest) + _WORTH:
            fit = simpler
        result[group] = case.simulate(fit.candidate, group)
    return result, tuple(range(n_episodes))


def _after(case: _Case, conclusion: Conclusion, explained):
    """What the simulator gives once the named effects are in it, driven by commands where the arms deviate."""
    if not case.arms.deviates:
        return explained
    return (
        explained + case.simulate(conclusion.best.candidate, predicted=True) - case.simulate(conclusion.best.candidate)
    )


def _ahead(case: _Case, before, after) -> tuple[dict[str, float] | None, float]:
    """Errors five seconds ahead [mm], and the share of the squared leftover that the online residual takes away."""
    recording = case.recording
    arguments = recording.gripper_pose, recording.interval, recording.length
    nominal = predicted_ahead(recording.keypoints, before, *arguments)
    named = predicted_ahead(recording.keypoints, after, *arguments)
    if nominal is None or named is None:
        return None, 0.0
    # both ends of the prediction are observed with noise
    noise = 2 * float(np.mean(case.noise.std**2))
    left = max(named.alone**2 - noise, 0.0)
    learnable = (named.alone**2 - max(named.corrected**2, noise)) / left if left > 0.1 * noise else 0.0
    errors = {"nominal": 1e3 * nominal.alone, "ridge": 1e3 * nominal.corrected, "named": 1e3 * named.alone}
    return errors, float(np.clip(learnable, 0.0, 1.0))


def _gap(case: _Case, before, after, held_out, verdict) -> Gap:
    observed, interval = case.recording.keypoints, case.recording.interval
    floor = float(np.sqrt(np.mean(case.noise.std**2)))

    def squares(simulated, until=np.inf):
        early = (np.arange(observed.shape[1])[None] * interval[:, None]) <= until
        difference = np.where(early[..., None, None], simulated - observed, np.nan)
        return np.nansum(difference**2, axis=(1, 2, 3)), np.isfinite(difference).sum(axis=(1, 2, 3))

    def rmse(simulated, until=np.inf):
        total, count = squares(simulated, until)
        return float(np.sqrt(total.sum() / count.sum()))

    (b, count), (a, _) = squares(before), squares(after)
    noise = floor**2 * count

    def shrinkage(chosen):
        denominator = (b - noise)[chosen].sum()
        return 1 - max((a - noise)[chosen].sum(), 0.0) / denominator if denominator > 0 else np.nan

    resolvable = verdict != "none"
    interval90 = None
    if resolvable and len(b) > 1:
        rng = np.random.default_rng(0)
        draws = [shrinkage(rng.integers(0, len(b), len(b))) for _ in range(1000)]
        low, high = np.nanquantile(draws, (0.05, 0.95))
        interval90 = float(low), float(high)
    total = b.sum()
    share = {
        "noise": float(min(noise.sum() / total, 1.0)),
        "named": float(max((b - np.maximum(a, noise)).sum(), 0.0) / total) if resolvable else 0.0,
    }
    left = max(1.0 - share["noise"] - share["named"], 0.0)
    ahead, learnable = _ahead(case, before, after)
    share["learnable"] = learnable * left
    share["unexplained"] = left - share["learnable"]
    return Gap(
        before_rmse_mm=1e3 * rmse(before),
        after_rmse_mm=1e3 * rmse(after),
        noise_floor_mm=1e3 * floor,
        shrinkage=float(shrinkage(np.arange(len(b)))) if resolvable else None,
        shrinkage_ci90=interval90,
        ahead_mm=ahead,
        horizons_mm={
            h: (1e3 * rmse(before, h), 1e3 * rmse(after, h))
            for h in (*_HORIZONS, float(np.round((interval * (case.recording.length - 1)).max(), 3)))
        },
        held_out_episodes=held_out,
        split=share,
    )
