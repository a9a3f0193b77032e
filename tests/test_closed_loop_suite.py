"""Suites of trials: what is run, what is kept, what is not run again."""

import argparse
import functools
import multiprocessing
import pickle
import re
import signal
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cablejax.cable import Discretisation
from cablejax.control.loop import run_closed_loop
from cablejax.control.shaping import load_model
from cablejax.control.targets import make_target
from cablejax.dynamics.train_config import Phase
from cablejax.effects.given import GivenEffect
from cablejax.mpc import MPC, MPCConfig
from cablejax.simulate.chain.statics import resting_shapes
from cablejax.simulate.plant import Plant, PlantConfig
from cli_cases import small_model
from closed_loop.cases import PLANT_CHAIN, mujoco_plant, nearby_cases, random_cases, stiffness_cases
from closed_loop.experiment import Experiment, Extent, page, seed_range
from closed_loop.fine_tuning import FineTuneConfig, fine_tune, record
from closed_loop.harder import harder_cases, nearest_rest
from closed_loop.methods import LABEL, METHODS, controller_of
from closed_loop.paper import VISUAL_SERVO
from closed_loop.protocols import LaidOut, letter_task
from closed_loop.suite import Case, key_of, read_suite, run_suite
from closed_loop.visual_servo import VisualServo
from executors import ExecutorError, executor_of
from mpc_cases import hermite_shape

CABLE = Discretisation(n_links=12, dimension=3, timestep=0.005)
SERVO = METHODS[VISUAL_SERVO]


@functools.lru_cache
def small_plant():
    return Plant(PlantConfig(discretisation=CABLE, settle_time=0.1))


def case(seed, scenario="U"):
    task = functools.partial(letter_task, scenario, seed, CABLE)
    return Case("III", scenario, 1.0, seed, task, small_plant, "small", steps=2)


def no_model(case):
    raise AssertionError("a method without a model asks for none")


@pytest.mark.slow
def test_a_suite_is_shared_resumed_and_read_whole(tmp_path):
    cases = [case(1), case(0)]
    with executor_of("2") as executor:
        run_suite(cases, [SERVO], tmp_path, fine_tuned=no_model, executor=executor, progress=False)
    trials, snapshots = read_suite(tmp_path)
    trials = sorted(trials, key=lambda trial: trial.seed)
    assert {t.key for t in trials} == {key_of(c, SERVO) for c in cases} == {s.key for s in snapshots}
    assert all(t.steps == 2 and 20 < t.errors_cm[0] < 60 for t in trials)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    run_suite(cases, [SERVO], tmp_path, fine_tuned=no_model, progress=False)
    assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}
    extent = Extent(lambda seeds: [one for one in cases if one.seed in seeds], range(2), ())
    experiment = Experiment("x", "x.py", "Title", "About.", extent, extent, ("III", "IV"))
    text = page(experiment, trials, "python x.py", "where", picture=None)
    assert "| online visual servo | 2 |" in text and "Table IV" not in text and "Seeds: 0, 1." in text
    assert "### How runs end" in text and "| online visual servo | U | 2 |" in text
    assert re.search(r"the grippers need on average U [789]\.\d s from these starts", text)


@pytest.mark.parametrize("cases", [nearby_cases, random_cases, harder_cases])
def test_cases_can_be_sent_to_another_process(cases):
    made = cases([3])
    again = pickle.loads(pickle.dumps(made))
    assert [key_of(one, SERVO) for one in again] == [key_of(one, SERVO) for one in made]


@pytest.mark.slow
def test_a_suite_that_loses_one_of_four_processes_ends_as_alone(tmp_path):
    cases, killed, lines = [case(seed) for seed in range(8)], [], tmp_path / "shared" / "trials.jsonl"

    def kill_one():
        while not lines.exists():  # until the first row
            time.sleep(0.01)
        killed.append(multiprocessing.active_children()[0])
        killed[0].kill()

    with executor_of("4") as executor:
        watcher = threading.Thread(target=kill_one, daemon=True)
        watcher.start()
        with pytest.raises(ExecutorError, match="run the same command to go on"):
            run_suite(cases, [SERVO], lines.parent, fine_tuned=no_model, executor=executor, progress=False)
        watcher.join()
    kept = lines.read_text()
    assert killed[0].exitcode == -signal.SIGKILL and 1 <= kept.count("\n") < len(cases)
    with executor_of("4") as executor:
        run_suite(cases, [SERVO], lines.parent, fine_tuned=no_model, executor=executor, progress=False)
    assert lines.read_text().startswith(kept), "nothing is lost"
    run_suite(cases, [SERVO], tmp_path / "alone", fine_tuned=no_model, progress=False)
    shared, alone = ({t.key: t.errors_cm for t in read_suite(tmp_path / f)[0]} for f in ("shared", "alone"))
    assert shared == alone and lines.read_text().count("\n") == len(cases), "nothing is doubled"


@pytest.mark.slow
def test_the_best_of_a_recorded_shape_keeps_to_the_bounds_on_the_grippers():
    def best(distance):
        pose = np.array([[0.0, 0.0, 1.2], [distance, 0.0, -1.2]])
        return nearest_rest(np.asarray(arch_between(pose)))

    allowed = MPCConfig.min_distance * PLANT_CHAIN.cable.length
    assert best(2 * allowed) < 0.02, "a shape in which the cable rests"
    # each gripper is at least so far off as the bound is from the target's distance, the two ends of 13 keypoints
    assert best(allowed / 2) > 100 * allowed / 4 * np.sqrt(2 / 13)


def arch_between(pose):
    """Keypoints of the cable at rest between these grippers, from an arch on."""
    arch = hermite_shape(jnp.asarray(pose), 13)
    for _ in range(6):
        arch = resting_shapes(arch, jnp.asarray(pose), jnp.asarray(pose), length=PLANT_CHAIN.cable.length)[1]
    return arch


def test_cases_are_those_of_the_paper():
    cases = stiffness_cases(("U", "S", "Z"), (0.1, 3.0), seeds=range(2))
    assert len({(c.scenario, c.stiffness, c.seed) for c in cases}) == len(cases) == 12
    assert mujoco_plant(0.1).config.effects == (GivenEffect("bending_stiffness", (("ratio", 0.1),)),)
    pairs = random_cases(seeds=range(2))
    assert {(c.scenario, c.seed) for c in pairs} == {(s, k) for s in ("straight", "diverse") for k in range(2)}
    assert all(c.steps == 250 for c in pairs)
    assert set(METHODS) == set(LABEL)


def test_every_method_has_its_controller(tmp_path):
    small_model(tmp_path)
    model, target = load_model(str(tmp_path)), make_target("U")
    assert isinstance(controller_of(SERVO, None, target), VisualServo)
    for spec in METHODS.values():
        if spec.weights is not None:
            controller = controller_of(spec, model, target)
            assert isinstance(controller, MPC)
            assert (controller.config.residual is not None) == (spec.learner is not None)


@pytest.mark.slow
def test_fine_tuning_records_the_cable_at_hand_and_changes_the_weights(tmp_path):
    small_model(tmp_path / "source")
    phase = Phase(steps=2, batch=2, rollout=1)
    config = FineTuneConfig(str(tmp_path / "source"), trajectories=2, commands=3, phases=(phase,))
    data = record(small_plant(), CABLE, config, tmp_path / "tuned" / "recording.npz")
    assert data.keypoints.shape == (2, 4, 13, 2) and data.gripper_twist.shape == (2, 3, 2, 3)
    np.testing.assert_allclose(data.keypoints[:, :, [0, -1]], data.gripper_pose[..., :2], atol=5e-3)
    again = record(small_plant(), CABLE, config, tmp_path / "tuned" / "recording.npz")
    np.testing.assert_array_equal(again.keypoints, data.keypoints)
    tuned, source = fine_tune(data, config, tmp_path / "tuned"), load_model(config.weights)
    assert tuned.config == source.config, "scales stay"
    change = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), tuned.weights, source.weights)
    assert max(jax.tree.leaves(change)) > 0


def test_a_run_ends_when_nothing_happens_any_more():
    class Still:
        def init(self, history):
            return None

        def step(self, state, measurement):
            return None, np.zeros((2, 3)), None

    task = letter_task("U", 0, CABLE)
    run = run_closed_loop(
        LaidOut(small_plant(), task.start_shape), Still(), task.target, 30, start=task.start_pose, patience=3
    )
    assert len(run.times) == 4 and run.stopped is None
    with pytest.raises(ValueError, match="no shape"):
        letter_task("Q", 0, CABLE)


def test_seeds_are_named_by_their_range():
    assert seed_range("100:103") == range(100, 103) and seed_range("7") == range(7, 8)
    with pytest.raises(argparse.ArgumentTypeError, match="100:150"):
        seed_range("5:5")
    with pytest.raises(ValueError, match="invalid literal"):
        seed_range("many")
