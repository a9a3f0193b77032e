"""A simulator of one's own through the protocol: the notebook's arm in MJX, and adapters that break the protocol."""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import pathlib
import re
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from cablejax.diagnose import (
    Calibration,
    Effect,
    Parameter,
    Simulator,
    diagnose_simulator,
    explanation,
    in_batches,
    verdict_json,
    write_verdict,
)
from cablejax.diagnose.protocol import Plan

NOTEBOOK = pathlib.Path(__file__).parents[1] / "notebooks" / "05_your_own_simulator.ipynb"


def adapter_of(notebook: pathlib.Path) -> tuple[str, dict[str, Any]]:
    """The cell that has the arm and its adapter, and what it defines."""
    cells = nbformat.read(notebook, as_version=4).cells
    (source,) = [cell.source for cell in cells if "adapter" in cell.metadata.get("tags", ())]
    defined: dict[str, Any] = {}
    exec(compile(source, str(notebook), "exec"), defined)
    return source, defined


SOURCE, DEFINED = adapter_of(NOTEBOOK)
Arm, INTERVAL = DEFINED["Arm"], DEFINED["INTERVAL"]


def test_an_adapter_with_its_model_is_at_most_60_lines():
    assert len(SOURCE.splitlines()) <= 60


def commands(episodes: int = 6, samples: int = 150) -> np.ndarray:
    """Swings of both joints with other amplitudes, speeds and places in every episode [rad], shape [E, T, 2]."""
    rng, t = np.random.default_rng(1), INTERVAL * np.arange(samples)[:, None]
    drawn = [(rng.uniform(-1, 1, 2), rng.uniform(0.2, 0.7, 2), rng.uniform(1.5, 5.0, 2)) for _ in range(episodes)]
    return np.stack([at + size * np.sin(speed * t) for at, size, speed in drawn]).astype(np.float32)


NOISE = 1e-3
HIDDEN = {"joint_friction": 0.8, "payload": 0.4, "actuator_gain": 0.95, "actuator_lag": 0.05}


@functools.cache
def recorded(name: str | None, seed: int = 0) -> np.ndarray:
    """Encoders of an arm with one hidden effect, or none."""
    arm = Arm(commands())
    hidden = [(effect, 0, (HIDDEN[name],)) for effect in arm.effects if effect.name == name]
    angles = arm.predict([explanation(*hidden)], np.arange(len(arm.commands)))[0]
    return angles + np.random.default_rng(seed).normal(0.0, NOISE, angles.shape)


@pytest.mark.parametrize("name", HIDDEN)
def test_the_hidden_effect_is_named_with_its_size(name):
    result = diagnose_simulator(Arm(commands()), recorded(name), interval=INTERVAL, noise=NOISE)
    assert result.verdict == "named" and result.equivalent == ()
    (effect,) = result.effects
    assert effect.name == name == result.ranking[0].name and effect.probability > 0.9
    (estimate,) = effect.parameters.values()
    assert estimate.value == pytest.approx(HIDDEN[name], rel=0.03)
    assert estimate.ci90[0] < HIDDEN[name] < estimate.ci90[1]
    assert result.gap.shrinkage > 0.98


@pytest.mark.parametrize("seed", range(3))
def test_an_arm_as_believed_gets_no_name(seed):
    result = diagnose_simulator(Arm(commands()), recorded(None, seed), interval=INTERVAL)
    assert result.verdict == "none" and result.effects == () and result.gap.shrinkage is None
    # estimated from the recording
    assert result.gap.noise_floor_mm == pytest.approx(1e3 * NOISE, rel=0.1)


def test_a_cause_outside_the_library_is_unknown():
    """The elbow's resolver errs eight times per turn."""
    observed = recorded(None).copy()
    observed[..., 1] += 0.02 * np.sin(8 * observed[..., 1])
    result = diagnose_simulator(Arm(commands()), observed, interval=INTERVAL, noise=NOISE)
    assert result.verdict == "unknown" and result.effects == ()
    assert verdict_json(result)["gap"]["shrinkage"] == 0.0


def test_what_the_adapter_does_not_compute_is_null(tmp_path):
    result = diagnose_simulator(Arm(commands()), recorded("payload"), interval=INTERVAL)
    assert write_verdict(tmp_path / "verdict.json", result).stat().st_size > 100
    verdict = verdict_json(result)
    assert verdict["where"] is verdict["next_motion"] is verdict["leftover_p"] is None
    gap = verdict["gap"]
    assert gap["ahead_mm"] is gap["split"]["learnable"] is gap["before_rmse_mm"] is None
    assert gap["unit"] == "rad" and gap["before_rmse"] > gap["after_rmse"] == pytest.approx(gap["noise_floor"], rel=0.1)
    assert verdict["ranking"][0]["leftover_mm"] is None
    assert verdict["effects"][0]["location"] == {"along_cable_m": None, "time_s": None, "table_m": None}


def tells_the_story(notebook):
    """The hidden effect is named, an arm as believed is not blamed, and what nobody thought of is unknown."""
    text = "".join(
        output.get("text", "")
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if output.get("name") == "stdout"
    )
    hidden = re.search(r"hidden: (\w+) = ", text)
    assert hidden and f"one hidden effect: named - The gap comes from {hidden[1].replace('_', ' ')}," in text
    assert "as believed: none - " in text and "resolver: unknown - " in text


def test_the_notebook_was_run_before_it_was_kept():
    tells_the_story(nbformat.read(NOTEBOOK, as_version=4))


@pytest.mark.slow
def test_the_notebook_runs():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
    tells_the_story(notebook)


# What follows needs no physics: a line through the origin, its slope and its offset, seen at two places.


class Line(Simulator):
    effects = (
        Effect(name="slope", parameters=(Parameter("ratio", "", 0.1, 10.0, 1.0, 0.5),), null=(1.0,)),
        Effect(
            name="offset",
            parameters=(Parameter("offset_m", "m", -1.0, 1.0, 0.0, 0.1),),
            null=(0.0,),
            amplitude=0,
            reversible=True,
            variants=(0, 1),
            variant_name="place",
            repeatable=True,
        ),
    )
    right_scores = (0.1, 0.2, 0.3)

    def __init__(self, x):
        self.x = x

    def predict(self, explanations, episodes):
        result = []
        for one in explanations:
            seen = np.repeat(self.x[episodes][..., None], 2, axis=-1)
            for term, z in one.by_term():
                (value,) = term.values(z)
                if term.effect.name == "slope":
                    seen = value * seen
                else:
                    seen[..., term.variant] += value
            result.append(seen)
        return np.stack(result)


X = np.cumsum(np.random.default_rng(0).normal(0.0, 0.05, (6, 200)), axis=1)


def line(*parts, missing=None):
    by_name = {effect.name: effect for effect in Line.effects}
    truth = explanation(*((by_name[name], variant, (value,)) for name, variant, value in parts))
    clean = Line(X).predict([truth], np.arange(len(X)))[0]
    seen = clean + np.random.default_rng(1).normal(0.0, 1e-3, clean.shape)
    if missing is not None:
        seen[missing] = np.nan
    return seen


def diagnose_line(seen, simulator=None, **options):
    return diagnose_simulator(simulator or Line(X), seen, interval=0.1, **{"noise": 1e-3, **options})


def test_two_variants_of_one_effect_act_together():
    result = diagnose_line(line(("offset", 0, 0.05), ("offset", 1, -0.03)))
    (effect,) = result.effects
    assert result.verdict == "named" and effect.name == "offset"
    found = dict(zip(effect.parameters["place"].value, effect.parameters["offset_m"].value, strict=True))
    assert found == {0: pytest.approx(0.05, abs=1e-3), 1: pytest.approx(-0.03, abs=1e-3)}
    assert verdict_json(result)["gap"]["before_rmse_mm"] > 10 and result.leftover_p == 1.0


def test_a_simulator_that_is_exact_has_no_gap():
    """As one who tries it on the simulator's own prediction finds: all of an error of 0 is noise."""
    result = diagnose_line(Line(X).predict([explanation()], np.arange(len(X)))[0])
    assert result.verdict == "none" and result.gap.before_rmse_mm == 0.0
    assert result.gap.split == {"noise": 1.0, "named": 0.0, "learnable": None, "unexplained": 0.0}


def test_missing_observations_and_short_episodes_do_not_matter():
    missing = np.zeros((6, 200, 2), bool)
    missing[0, 120:], missing[1:3, 50:90, 1] = True, True
    result = diagnose_line(line(("slope", 0, 1.3), missing=missing))
    (effect,) = result.effects
    assert effect.name == "slope" and effect.parameters["ratio"].value == pytest.approx(1.3, abs=0.005)
    assert result.gap.horizon_s == pytest.approx(19.9)


def test_an_episode_of_which_nothing_was_seen_says_nothing():
    missing = np.zeros((6, 200, 2), bool)
    missing[2] = True
    assert diagnose_line(line(("slope", 0, 1.3), missing=missing)).verdict == "named"
    assert diagnose_line(line(missing=missing)).verdict == "none"


def test_derivatives_of_the_simulators_own_are_used():
    class Exact(Line):
        asked = 0

        def linearise(self, explanations, episodes):
            Exact.asked += 1
            return super().linearise(explanations, episodes)

    result = diagnose_line(line(("slope", 0, 1.3)), Exact(X))
    assert result.effects[0].name == "slope" and Exact.asked > 3


def test_a_simulation_that_breaks_down_beyond_a_value_is_survived():
    class Fragile(Line):
        def predict(self, explanations, episodes):
            predicted = super().predict(explanations, episodes)
            predicted[[bool(one.vector(self.effects[:1])[0] > 1.4) for one in explanations]] = np.nan
            return predicted

    (effect,) = diagnose_line(line(("slope", 0, 1.3)), Fragile(X)).effects
    assert effect.name == "slope" and effect.parameters["ratio"].value == pytest.approx(1.3, abs=0.01)


def test_an_effect_that_fits_only_beside_another_is_named_without_it():
    class Snapping(Line):
        # without an offset, most slopes take another way than the observed one, and fits end there
        def predict(self, explanations, episodes):
            predicted, x = super().predict(explanations, episodes), self.x[episodes][..., None]
            slope, offset = np.array([one.vector(self.effects) for one in explanations]).T
            other = (np.abs(slope - 1.3) > 0.02) & (np.abs(offset) < 1e-3)
            predicted[other] += 0.2 * x + 0.1 * np.abs(x)
            return predicted

    result = diagnose_line(line(("slope", 0, 1.3)), Snapping(X))
    (effect,) = result.effects
    assert result.verdict == "named" and effect.name == "slope"
    assert effect.parameters["ratio"].value == pytest.approx(1.3, abs=0.005)


def test_calm_motions_do_not_take_a_gap_away():
    # 2.5 mm, more than 1.6 errors of the simulator; 1.4 mm over all motions once eight calm ones are recorded besides
    moved = (0.02 + 0.001 * np.arange(4)[:, None]) * np.linspace(-1.0, 1.0, 200)
    x = np.append(moved, np.zeros((8, 200)), axis=0)
    seen = 1.2 * x[..., None].repeat(2, axis=-1) + np.random.default_rng(1).normal(0.0, 1e-3, (12, 200, 2))
    for n in (4, 12):
        result = diagnose_line(seen[:n], Line(x[:n]), calibration=Calibration(baseline=1e-3))
        assert result.verdict == "named" and [effect.name for effect in result.effects] == ["slope"]
    assert diagnose_line(seen[4:], Line(x[4:]), calibration=Calibration(baseline=1e-3)).verdict == "none"


def test_one_motion_leaves_nothing_to_check_on():
    result = diagnose_line(line(("slope", 0, 1.3)), motion=np.zeros(6, int))
    assert result.gap.shrinkage is result.gap.shrinkage_ci90 is None and result.gap.held_out_episodes == ()


def broken(**methods):
    return type("Broken", (Line,), methods)(X)


def moved_null():
    slope = dataclasses.replace(Line.effects[0], null=(1.2,))
    return broken(effects=(slope,))


BAD = {
    "no episodes": (lambda: Line(X), {}, np.zeros((3, 4)), r"\[E, T, \.\.\.\]"),
    "nothing seen": (lambda: Line(X), {}, np.full((6, 200, 2), np.nan), "at least one observed"),
    "interval": (lambda: Line(X), {"interval": 0.0}, None, "interval is 0.0 s"),
    "an interval too many": (lambda: Line(X), {"interval": np.full(7, 0.1)}, None, "one for each of 6"),
    "infinite": (lambda: Line(X), {}, np.full((6, 200, 2), np.inf), "observed has infinite values"),
    "a list": (
        lambda: broken(predict=lambda self, ones, episodes: Line.predict(self, ones, episodes).tolist()),
        {},
        None,
        "predict gave a list, expected a NumPy array",
    ),
    "whole numbers": (
        lambda: broken(predict=lambda self, ones, episodes: Line.predict(self, ones, episodes).astype(int)),
        {},
        None,
        "predict gave an array of int64, expected",
    ),
    "the class": (lambda: Line, {}, None, "simulator is the class Line, expected an instance"),
    "names of effects": (lambda: broken(effects=("slope",)), {}, None, "hold a str"),
    "text": (lambda: Line(X), {}, np.full((6, 200, 2), "a"), "array of <U1, expected real numbers"),
    "settings": (lambda: Line(X), {"calibration": {"baseline": 1.0}}, None, "expected a `Calibration`"),
    "noise of another shape": (lambda: Line(X), {"noise": np.ones(3)}, None, "does not broadcast"),
    "no noise": (lambda: Line(X), {"noise": 0.0}, None, "no measurement is exact"),
    "motion": (lambda: Line(X), {"motion": np.zeros(5, int)}, None, "one whole number for each of 6 episodes"),
    "motion is no number": (lambda: Line(X), {"motion": [np.nan] * 6}, None, "motion is float64 of shape"),
    "starts of another effect": (
        lambda: broken(starts=lambda self, effect, *_: [(0, (1.0, 2.0))]),
        {},
        line(("slope", 0, 2.0)),
        r"has the values \[1.0, 2.0\], expected one number each",
    ),
    "starts of no variant": (
        lambda: broken(starts=lambda self, effect, *_: [(7, (1.0,))]),
        {},
        line(("slope", 0, 2.0)),
        "has the variant 7, expected one of",
    ),
    "one name twice": (lambda: broken(effects=Line.effects[:1] * 2), {}, None, "every name once"),
    "no effects": (lambda: broken(effects=()), {}, None, "at least one"),
    "null that acts": (moved_null, {}, None, "at its null value .* changes the prediction"),
    "another shape": (
        lambda: broken(predict=lambda self, explanations, episodes: np.zeros((len(explanations), 6, 200))),
        {},
        None,
        r"shape \(3, 6, 200\), expected \(3, 6, 200, 2\)",
    ),
    "all episodes always": (
        lambda: broken(predict=lambda self, ones, episodes: Line.predict(self, ones, np.arange(6))),
        {},
        None,
        "has to simulate the episodes that it is asked for",
    ),
    "diverges": (
        lambda: broken(predict=lambda self, ones, episodes: np.nan * Line.predict(self, ones, episodes)),
        {},
        None,
        "is not finite in samples that were observed",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_does_not_keep_to_the_protocol_is_refused(case):
    build, options, seen, message = BAD[case]
    options = {"noise": 1e-3, "interval": 0.1, **options}
    with pytest.raises(ValueError, match=message):
        diagnose_simulator(build(), line() if seen is None else seen, **options)


@pytest.mark.parametrize("baseline", [np.nan, -1.0])
def test_a_calibration_of_nonsense_is_refused(baseline):
    with pytest.raises(ValueError, match=r"Calibration.baseline is .*, expected a finite number"):
        Calibration(baseline=baseline)


def test_names_of_parameters_are_there_once():
    twice = Line.effects[0].parameters[:1] * 2
    with pytest.raises(ValueError, match="every one once"):
        Effect(name="odd", parameters=twice, null=(0.0, 0.0))


def test_fits_do_not_begin_where_an_effect_is_switched_off():
    """There nothing depends on the place or the time at which it acts."""
    size, when = Parameter("size", "m", -1.0, 1.0, 0.0, 0.1), Parameter("when_s", "s", 0.0, 3.0, 1.5, 0.6)
    starts = [values for _, values in Effect(name="step", parameters=(size, when), null=(0.0, 0.0)).starts(None)]
    wanted = {(s, w) for s in (-0.1, 0.1) for w in (0.9, 1.5, 2.1)}
    assert {(round(s, 9), round(w, 9)) for s, w in starts} == wanted and len(starts) == len(wanted)
    # both are what they are at the null: either may switch it off, unless the effect says which
    both = [values for _, values in Effect(name="step", parameters=(size, when), null=(0.0, 1.5)).starts(None)]
    assert set(starts) < set(both) and len(both) == 8
    told = Effect(name="step", parameters=(size, when), null=(0.0, 1.5), amplitude=0)
    assert {values for _, values in told.starts(None)} == set(starts)
    positive = Effect(name="pull", parameters=(Parameter("size", "m", 0.0, 1.0, 0.0, 0.1), when), null=(0.0, 0.0))
    assert [values[0] for _, values in positive.starts(None)] == [0.1] * 3
    ratio = Effect(name="ratio", parameters=(Parameter("ratio", "", 0.1, 10.0, 2.0, 0.5, log=True),), null=(1.0,))
    assert len(ratio.starts(None)) == 2


def test_an_effect_has_a_null_for_each_parameter():
    with pytest.raises(ValueError, match="1 parameters and 2 null values"):
        Effect(name="odd", parameters=Line.effects[0].parameters, null=(0.0, 1.0))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"amplitude": 1}, "amplitude is 1, expected the index of one of its 1 parameters"),
        ({"variants": ()}, "no variant"),
        ({"null": (np.nan,)}, "null values .nan,., expected numbers"),
    ],
)
def test_an_effect_that_contradicts_itself_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Effect(**{"name": "odd", "parameters": Line.effects[0].parameters[:1], "null": (0.0,), **wrong})


def test_a_simulator_without_any_start_explains_nothing():
    result = diagnose_line(line(("slope", 0, 2.0)), broken(starts=lambda self, effect, *_: []))
    assert result.verdict == "unknown" and not result.effects


def test_batches_are_of_one_size_and_pairs_in_place():
    sizes = []

    def run(values, inputs):
        sizes.append(len(values))
        return values[:, :1] * inputs

    values, inputs = np.arange(1.0, 6.0)[:, None], np.arange(12.0).reshape(3, 4)
    result = in_batches(run, values, inputs, size=4)
    np.testing.assert_array_equal(result, values[:, None] * inputs)
    assert set(sizes) == {4} and len(sizes) == 4


GENERIC = (
    "belief", "conclude", "diagnosis", "evidence", "fit", "gap", "given_arrays", "judgement", "laws",
    "noise", "posterior", "protocol", "refits", "run", "screen", "search",
)  # fmt: skip
ALLOWED = {f"cablejax.diagnose.{name}" for name in GENERIC} | {
    "cablejax.arrays",
    "cablejax.bounded",
    "cablejax.effects.effect",
    "cablejax.provenance",
}


@pytest.mark.parametrize("name", GENERIC)
def test_what_is_generic_imports_no_cable(name):
    tree = ast.parse(inspect.getsource(importlib.import_module(f"cablejax.diagnose.{name}")))
    imported = {node.module for node in tree.body if isinstance(node, ast.ImportFrom) and node.module}
    own = {module for module in imported if module.startswith("cablejax")}
    assert own <= ALLOWED


class Swing(Simulator):
    """A damped oscillation, started from other amplitudes."""

    unit = "m"
    effects = (Effect(name="stiffer", parameters=(Parameter("ratio", "", 0.1, 10, 1.5, 0.5, log=True),), null=(1.0,)),)

    def predict(self, explanations, episodes):
        time, amplitude = 0.05 * np.arange(200), np.linspace(0.5, 1.5, 3)[episodes]
        rates = [2 * np.sqrt(one.vector(self.effects)[0]) for one in explanations]
        return np.stack([np.outer(amplitude, np.cos(rate * time))[..., None] for rate in rates])


def test_one_episode_shows_a_gap_and_too_little_of_it_to_name_its_cause():
    """No effect pays for itself in it; that does not mean that the library lacks the cause."""
    swing, noise = Swing(), 1e-3 * np.random.default_rng(0).normal(size=(2, 200, 1))
    true = swing.predict([explanation((Swing.effects[0], 0, [1.3]))], np.arange(2))[0] + noise
    dear = Calibration(baseline=1e-4, term_cost=12.0)
    found = [diagnose_simulator(swing, true[:n], interval=0.05, noise=1e-3, calibration=dear) for n in (1, 2)]
    assert [one.verdict for one in found] == ["unknown", "named"]
    sentence = found[0].sentence
    assert sentence.startswith("There is a gap, but this log shows too little of it") and "library" not in sentence


GAIN = Effect(
    name="gain", parameters=(Parameter("gain", "", 0.1, 3.0, 1.0, 0.3),), null=(1.0,), amplitude=0, reversible=True
)


class Gained(Simulator):
    """A signal of which a gain is unknown; NaN where its episode has ended."""

    unit = "m"
    effects = (GAIN,)

    def __init__(self, count: int, plan: Plan | None = None):
        self.plan, time = plan or Plan(), 0.05 * np.arange(300)
        self.signal = np.stack([np.sin((0.5 + 0.2 * e) * time) for e in range(count)])[..., None]
        self.signal[1:, 200:] = np.nan

    def predict(self, explanations, episodes):
        gains = np.array([one.values()[0][0] if one.terms else 1.0 for one in explanations])
        return gains[:, None, None, None] * self.signal[np.asarray(episodes, int)]

    def seen(self) -> np.ndarray:
        return 1.2 * self.signal + 0.01 * np.random.default_rng(0).standard_normal(self.signal.shape)


def test_a_simulator_may_end_where_its_episode_does():
    simulator = Gained(4)
    found = diagnose_simulator(simulator, simulator.seen(), interval=0.05)
    assert found.verdict == "named" and found.effects[0].parameters["gain"].value == pytest.approx(1.2, abs=0.05)


def test_of_one_episode_nothing_is_left_out_whatever_the_plan():
    simulator = Gained(1, Plan(parts=4))
    found = diagnose_simulator(simulator, simulator.seen(), interval=0.05)
    assert found.verdict == "named" and found.gap.held_out_episodes == ()
