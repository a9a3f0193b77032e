"""Makes one case: draws cable, motions and effects, scales the effects, simulates, and writes the label."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from .effects import EFFECTS, Setup
from .motions import Commands, draw_motions
from .plan import Case
from .record import Record, Simulate, Unreachable, context_of, gap, quick, record
from .severity import search
from .twins import twins
from .world import World

ATTEMPTS = 4
TRACELESS = 0.7
"""Gap over noise below which the oracle, who knows the effect, sees no trace of it."""
SEVERITIES = (1, 2, 4, 8)


@dataclasses.dataclass
class Draft:
    """One attempt at a case.

    Attributes:
        world: the stated cable and table.
        commands: of every episode.
        draws: name, fixed draw and strength of every effect.
        setup: with all effects.
        before, after: noiseless, without and with the effects.
        noise: of the keypoints [m].
        parameters: of every effect, in the specification's words.
        components: gap over noise of every effect alone.
        reached: gap over noise.
        attempt: its number.
    """

    world: World
    commands: list[Commands]
    draws: list[tuple[str, dict[str, Any], float]]
    setup: Setup
    before: Record
    after: Record
    noise: float
    parameters: list[dict[str, Any]]
    components: list[float]
    reached: float
    attempt: int


def make_case(case: Case, seed: int, simulate: Simulate) -> Draft:
    """One case, noiseless.

    Args:
        case: from the plan.
        seed: of the plan.
        simulate: the family that records it; the strengths are first sought with family A at long time steps.

    Raises:
        Unreachable: no motions that suit the effect were found.
    """
    best: Draft | None = None
    for attempt in range(ATTEMPTS):
        try:
            draft = _draft(case, np.random.default_rng([seed, case.index, attempt]), attempt)
        except Unreachable:
            continue
        if case.kind == "none":
            best = draft
            break
        if best is None or _miss(draft, case) < _miss(best, case):
            best = draft
        if draft.reached > 0.8 * case.severity:
            break
    if best is None:
        raise Unreachable(f"Case {case.index} ({case.effects}): no motions suit it in {ATTEMPTS} attempts.")
    _record_in(case, best, simulate)
    return best


def label_of(case: Case, draft: Draft, seed: int, noisy: list[np.ndarray]) -> dict[str, Any]:
    """What is true of a case, given its keypoints as observed."""
    _, per_episode = gap(draft.after, draft.before)
    observed = [
        (float(np.nansum((seen - true) ** 2)), float(np.nansum((seen - plain) ** 2)), int(np.isfinite(seen).sum()))
        for seen, true, plain in zip(noisy, draft.after.keypoints, draft.before.keypoints, strict=True)
    ]
    after, before, count = np.sum(observed, axis=0)
    effects = [
        {"name": name, "parameters": _rounded(parameters)}
        for (name, _, _), parameters in zip(draft.draws, draft.parameters, strict=True)
    ]
    reached = draft.reached if draft.draws else 0.0
    return {
        "kind": case.kind,
        "family": case.family,
        "effects": effects,
        "severity": min(SEVERITIES, key=lambda s: abs(np.log(max(reached, 1e-6) / s))) if draft.draws else None,
        "target_gap_over_noise": case.severity,
        "gap_over_noise": round(reached, 3),
        "component_gap_over_noise": [round(component, 3) for component in draft.components],
        "traceless": bool(draft.draws) and reached < TRACELESS,
        "traceless_components": [component < TRACELESS for component in draft.components],
        "twins": twins(case, draft) if case.kind == "single" else {},
        "noise_mm": round(1e3 * draft.noise, 4),
        "oracle_after_mm": round(1e3 * float(np.sqrt(after / count)), 4),
        "gap_rmse_mm_noiseless": round(1e3 * reached * draft.noise, 3),
        "gap_rmse_mm_noisy": round(1e3 * float(np.sqrt(before / count)), 3),
        "gap_rmse_mm_per_episode": [round(1e3 * value, 3) for value in per_episode],
        "motions": [commands.motion for commands in draft.commands],
        "seed": seed,
        "index": case.index,
        "attempt": draft.attempt,
    }


def _draft(case: Case, rng: np.random.Generator, attempt: int) -> Draft:
    world = _cable(rng, other=attempt > 0)
    noise = rng.uniform(0.5e-3, 1.5e-3)
    wanted = EFFECTS[case.effects[0]].helpful if attempt > 0 and case.effects else ()
    commands = draw_motions(rng, world.length, wanted)
    plain = Setup(world)
    before = record(plain, commands, quick)
    if case.kind == "none":
        return Draft(world, commands, [], plain, before, before, noise, [], [], 0.0, attempt)
    context = context_of(world, commands, before)
    target = case.severity * noise / np.sqrt(len(case.effects))
    setup, parameters, components, draws = plain, [], [], []
    for name in case.effects:
        effect = EFFECTS[name]
        try:
            fixed = effect.draw(rng, context)
        except ValueError as error:
            raise Unreachable(str(error)) from error
        known = before if effect.side == "camera" else None

        def evaluate(strength: float, effect=effect, fixed=fixed, known=known) -> float:
            return gap(record(effect.apply(plain, fixed, strength)[0], commands, quick, known), before)[0]

        strength, alone = search(evaluate, target, effect.strengths)
        setup, said = effect.apply(setup, fixed, strength)
        parameters.append(said)
        components.append(alone / noise)
        draws.append((name, fixed, strength))
    after = record(setup, commands, quick)
    reached = gap(after, before)[0] / noise
    return Draft(world, commands, draws, setup, before, after, noise, parameters, components, reached, attempt)


def _record_in(case: Case, draft: Draft, simulate: Simulate) -> None:
    """The case by the simulator it is meant for, with one correction of the strength where the gap is another there."""
    plain = Setup(draft.world)
    draft.before = draft.after = record(plain, draft.commands, simulate)
    if not draft.draws:
        return
    sought = draft.reached
    camera_only = all(EFFECTS[name].side == "camera" for name, _, _ in draft.draws)

    def run(factor: float) -> None:
        setup, parameters = plain, []
        for name, fixed, strength in draft.draws:
            effect = EFFECTS[name]
            setup, said = effect.apply(setup, fixed, float(np.clip(strength * factor, *effect.strengths)))
            parameters.append(said)
        draft.after = record(setup, draft.commands, simulate, draft.before if camera_only else None)
        draft.setup, draft.parameters = setup, parameters
        draft.reached = gap(draft.after, draft.before)[0] / draft.noise

    run(1.0)
    # Where the search could not reach the severity, neither can a correction.
    aim = min(case.severity, sought) if sought < 0.8 * case.severity else case.severity
    if not 0.8 < draft.reached / aim < 1.25:
        run(float(np.clip(aim / draft.reached, 0.3, 3.0)))
    # The shares of a pair's two effects are those of the search.
    share = draft.reached / float(np.sqrt(np.sum(np.square(draft.components))))
    draft.components = [component * share for component in draft.components]


def _miss(draft: Draft, case: Case) -> float:
    return abs(float(np.log(max(draft.reached, 1e-6) / case.severity)))


def _cable(rng: np.random.Generator, other: bool) -> World:
    """The reference cable mostly, or another one."""
    if not other and rng.random() < 0.65:
        return World()
    if rng.random() < 0.8:  # softer, on a rougher table
        return World(
            stiffness=round(rng.uniform(0.008, 0.012), 4), linear_density=round(rng.uniform(0.065, 0.1), 3),
            friction=round(rng.uniform(0.25, 0.4), 2),
        )  # fmt: skip
    return World(
        stiffness=round(rng.uniform(0.015, 0.035), 4), linear_density=round(rng.uniform(0.06, 0.1), 3),
        friction=round(rng.uniform(0.15, 0.3), 2),
    )  # fmt: skip


def _rounded(parameters: dict[str, Any]) -> dict[str, Any]:
    def short(value):
        if isinstance(value, list):
            return [short(entry) for entry in value]
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return {name: short(value) for name, value in parameters.items()}
