"""A data set is the same, byte by byte, however it was made: in one go or after a kill, by one process or by two."""

import dataclasses
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.commands.train import Train
from cablejax.control.cable_inputs import CableInputs
from cablejax.control.shaping import load_model
from cablejax.dataset import generate as generation
from cablejax.dataset.drawing import draw
from cablejax.dataset.generate import (
    MAX_ATTEMPTS,
    GenerationInterrupted,
    find_fault,
    generate,
    make_engine,
    shards_at_once,
    simulate,
)
from cablejax.dataset.opening import open_store
from cablejax.dataset.schema import Block, DatasetConfig, Randomisation, config_from_json, config_to_json
from cablejax.dataset.windows import read_trajectories
from cablejax.effects.given import EFFECTS, GivenEffect, parse_effect
from cablejax.simulate import ThreadedEngine
from cablejax.simulate.motions import MotionConfig, random_motion
from file_cases import tree

TINY = DatasetConfig(
    n_trajectories=8,
    n_steps=3,
    shard_size=2,
    seed=5,
    # so few links can only take gentle motion
    motion=MotionConfig(max_step=0.03, min_distance=0.6, max_angle=0.6, max_curvature=3.0),
    discretisation=Discretisation(Cable(n_keypoints=4), n_links=7, timestep=0.02),
    randomisation=Randomisation(stiffness=(0.1, 3.0), friction=(0.5, 2.0)),
    engine="threaded",
)


def test_what_is_known_of_a_cable_has_its_effects(tmp_path):
    staged = (
        GivenEffect("bending_stiffness", (("ratio", 2.0),)),
        GivenEffect("table_friction", (("coefficient", 0.6),)),
    )
    posterior = (staged[:1], staged)
    generate(dataclasses.replace(TINY, posterior=posterior, n_trajectories=4), tmp_path / "a.zarr", progress=False)
    generate(dataclasses.replace(TINY, n_trajectories=4), tmp_path / "b.zarr", progress=False)
    with_them, without = (read_trajectories(tmp_path / name).cable for name in ("a.zarr", "b.zarr"))
    more = np.log(0.6 / TINY.cable.friction_coefficient)
    expected = np.array([[np.log(2.0), 0.0], [np.log(2.0), more]] * 2)
    np.testing.assert_allclose(with_them - without, expected, atol=1e-5)
    np.testing.assert_array_equal(read_trajectories(tmp_path / "a.zarr", [3, 1]).cable, with_them[[3, 1]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "asymmetric", "outside"),
    [
        ("table_friction:coefficient=0.5", (), ()),
        ("stiffness_profile:centre_m=0.3,width_m=0.3,ratio=0.3", ("stiffness_profile",), ()),
        ("camera_lag:time_s=0.5", ("camera_lag",), ("camera_lag",)),
        ("actuation_gain:gain=0.8", (), ("actuation_gain",)),
    ],
)
def test_a_training_flips_what_is_as_likely_and_is_of_the_cable_alone(tmp_path, text, asymmetric, outside):
    varied = Randomisation(stiffness=(0.5, 2.0))
    config = dataclasses.replace(STAGED, effects=(parse_effect(text),), interval=0.5, randomisation=varied)
    assert (config.asymmetric, config.untrainable) == (asymmetric, outside)
    generate(config, tmp_path / "data", progress=False)
    training = Train(data=(tmp_path / "data",), out=tmp_path / "out", preset="smoke", prior="rigid", conditioned=True)
    if outside:
        with pytest.raises(ValueError, match=rf"{outside[0]}\. A model is of the cable itself.*camera and of the arms"):
            training.execute()
    else:
        _, table = training.execute()
        assert table.partition("\n")[0].endswith(" 0.5 s"), "the only horizon, of one command"
        made = json.loads((tmp_path / "out" / "run.json").read_text())
        assert made["config"]["flips"] is not bool(asymmetric)
        # the second trajectory is held out
        (first, _), inputs = read_trajectories(tmp_path / "data").cable.tolist(), load_model(str(training.out)).inputs
        assert inputs == CableInputs(tuple(first), tuple((x, x) for x in first))


STAGED = dataclasses.replace(
    TINY, n_trajectories=2, n_steps=4, shard_size=2, engine="chain", randomisation=Randomisation()
)  # one shard
VALUES = {
    name: tuple(zip(names.split(), values, strict=True))
    for name, names, values in (
        ("bending_stiffness", "ratio", (3.0,)),
        ("stiffness_profile", "centre_m width_m ratio", (0.3, 0.2, 0.3)),
        ("intrinsic_curvature", "centre_m width_m curvature_per_m", (0.3, 0.2, 2.0)),
        ("plasticity", "yield_curvature_per_m", (0.2,)),
        ("bending_hysteresis", "moment_n_m transition_curvature_per_m", (0.02, 0.5)),
        ("bending_damping", "time_s", (5.0,)),
        ("axial_stretch", "stiffness_n", (1.0,)),
        ("table_friction", "coefficient", (0.5,)),
        ("friction_patch", "x_m y_m radius_m coefficient", (0.0, 0.0, 0.5, 1.0)),
        ("viscous_drag", "coefficient_n_s_per_m2", (5.0,)),
        ("gravity_tilt", "angle_rad direction_rad", (0.2, 1.0)),
        ("linear_density", "ratio", (3.0,)),
        ("lumped_mass", "centre_m mass_kg", (0.4, 0.1)),
        ("gripper_slip", "gripper time_s distance_m", (1, 1.0, 0.02)),
        ("gripper_rotation_offset", "gripper angle_rad", (0, 0.1)),
        ("gripper_compliance", "gripper stiffness_n_m_per_rad", (0, 0.1)),
        ("camera_similarity", "scale angle_rad x_m y_m", (1.02, 0.05, 0.01, 0.0)),
        ("keypoint_bias", "index offset_m", (2, 0.01)),
        ("camera_lag", "time_s", (0.3,)),
        ("actuation_gain", "gain", (0.8,)),
        ("actuation_lag", "time_s", (0.4,)),
    )
}

# A second process makes the same configuration as this one: it is passed as the source text of a DatasetConfig.
CHILD = """
import sys
from cablejax.dataset.generate import generate
from cablejax.dataset.schema import *
from cablejax.cable import Cable, Discretisation
from cablejax.simulate.motions import MotionConfig, random_motion
config, path = eval(sys.argv[1]), sys.argv[2]
"""


def child(code: str, config: DatasetConfig, path: Path, *arguments: str, **environment: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", CHILD + code, repr(config), str(path), *arguments],
        env=os.environ | {"NPROC": "4"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process: subprocess.Popen) -> str:
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output
    return output


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("reference") / "data"
    info = generate(TINY, path, progress=False)
    assert info.complete and info.attempts == 0
    return path


def test_trajectories_obey_the_protocol(reference):
    store = open_store(reference)
    block = store.read()
    assert block.keypoints.shape == (8, 4, 4, 2) and block.gripper_twist.shape == (8, 3, 2, 3)
    # poses follow from the commands, end keypoints from the poses
    moved = block.gripper_pose[:, :1] + np.cumsum(block.gripper_twist, axis=1)
    np.testing.assert_allclose(block.gripper_pose[:, 1:], moved, atol=1e-6)
    np.testing.assert_allclose(block.keypoints[:, :, [0, -1]], block.gripper_pose[..., :2], atol=1e-4)
    # a straight start, but for the slack of a few thousandths: no keypoint far from the line between the grippers
    first = block.keypoints[:, 0] - block.keypoints[:, :1, 0]
    aside = (first[:, :, 0] * first[:, -1:, 1] - first[:, :, 1] * first[:, -1:, 0]) / TINY.cable.length
    assert np.abs(aside).max() < 0.03
    size = np.sqrt((block.gripper_twist[..., :2] ** 2).sum(-1) + (0.15 * block.gripper_twist[..., 2]) ** 2)
    assert 0.003 < size.max() <= 0.03 * (1 + 1e-5)
    assert len(np.unique(block.gripper_twist[:, 0, 0, 0])) == 8


def test_parameters_are_drawn_log_uniformly_within_their_ranges():
    drawn = np.array([draw(TINY, index).parameters for index in range(400)])
    assert drawn[:, 0].min() >= 0.1 and drawn[:, 0].max() <= 3.0
    assert np.median(drawn[:, 0]) == pytest.approx(np.sqrt(0.3), rel=0.25)
    assert drawn[:, 1].min() >= 0.05 and drawn[:, 1].max() <= 0.2
    np.testing.assert_array_equal(drawn[:, 2], TINY.cable.damping_time)
    with pytest.raises(ValueError, match=r"Randomisation\.friction"):
        Randomisation(friction=(2.0, 1.0))


def test_parameters_reach_the_simulator():
    stiff, soft = (
        dataclasses.replace(TINY, randomisation=Randomisation(stiffness=(ratio, ratio)), n_trajectories=1)
        for ratio in (0.1, 10.0)
    )
    shapes = [simulate(config, ThreadedEngine(config.discretisation), [0])[0].keypoints for config in (stiff, soft)]
    assert np.abs(shapes[0] - shapes[1]).max() > 1e-3


@pytest.fixture(scope="module")
def by_chain() -> dict[str, np.ndarray]:
    """Gripper poses and keypoints without any effect, by the engine that simulates all effects."""
    (block,) = simulate(STAGED, make_engine(STAGED), [0])
    return {"keypoints": block.keypoints, "pose": block.gripper_pose, "twist": block.gripper_twist}


def in_the_way(keypoints: np.ndarray) -> tuple[tuple[str, float], ...]:
    """A disc of 3 cm into which `keypoints` [T + 1, N, 2] end up 5 mm deep."""
    along = keypoints[-1, -1] - keypoints[-1, 0]
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    moved = keypoints[-1, 2] - keypoints[0, 2]
    x, y = keypoints[-1, 2] + np.sign(moved @ across) * 0.025 * across
    return (("x_m", float(x)), ("y_m", float(y)), ("radius_m", 0.03))


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda effect: effect.name)
def test_every_effect_reaches_the_data(effect, by_chain):
    one = GivenEffect(effect.name, VALUES.get(effect.name) or in_the_way(by_chain["keypoints"][0]))
    config = dataclasses.replace(STAGED, effects=(one,))
    (block,) = simulate(config, make_engine(config), [0])
    assert block.attempts.max() == 0
    assert np.abs(block.keypoints - by_chain["keypoints"]).max() > 1e-4
    np.testing.assert_array_equal(block.gripper_twist, by_chain["twist"])
    moved = np.abs(block.gripper_pose - by_chain["pose"]).max() > 1e-4
    assert moved == (effect.hook == "input")


def test_effects_travel_in_the_store(tmp_path):
    effects = tuple(GivenEffect(name, VALUES[name]) for name in ("stiffness_profile", "lumped_mass"))
    config = dataclasses.replace(TINY, n_trajectories=2, effects=effects)
    assert config_from_json(DatasetConfig, json.loads(json.dumps(config_to_json(config)))) == config
    info = generate(config, tmp_path / "data", progress=False)
    assert open_store(tmp_path / "data").config.effects == effects
    plain = generate(dataclasses.replace(config, effects=()), tmp_path / "plain", progress=False)
    assert info.digest != plain.digest
    with pytest.raises(ValueError, match="effects is"):
        generate(dataclasses.replace(config, effects=effects[:1]), tmp_path / "data", progress=False)


def test_each_trajectory_has_its_draw_of_a_posterior():
    posterior = tuple((GivenEffect(name, VALUES[name]),) for name in ("stiffness_profile", "camera_similarity"))
    config = dataclasses.replace(STAGED, n_trajectories=2, shard_size=2, posterior=posterior)
    assert config_from_json(DatasetConfig, json.loads(json.dumps(config_to_json(config)))) == config
    assert config.effects_shown == tuple(f"{one[0].name} (in 1 of 2 draws)" for one in posterior)
    (block,) = simulate(config, make_engine(config), [0])
    for index, effects in enumerate(posterior):
        alone = dataclasses.replace(config, posterior=(), effects=effects)
        (other,) = simulate(alone, make_engine(alone), [0])
        np.testing.assert_array_equal(block.keypoints[index], other.keypoints[index])
        assert np.abs(block.keypoints[1 - index] - other.keypoints[1 - index]).max() > 1e-3
    stretched = (GivenEffect("axial_stretch", VALUES["axial_stretch"]),)
    with pytest.raises(ValueError, match="threaded cannot simulate axial_stretch"):
        dataclasses.replace(TINY, posterior=(*posterior, stretched))


def test_effects_that_an_engine_cannot_simulate_are_refused():
    with pytest.raises(ValueError, match=r"threaded cannot simulate axial_stretch.*: chain\."):
        dataclasses.replace(TINY, effects=(GivenEffect("axial_stretch", VALUES["axial_stretch"]),))
    with pytest.raises(ValueError, match="ratio is 1000"):
        dataclasses.replace(TINY, effects=(GivenEffect("bending_stiffness", (("ratio", 1000.0),)),))
    with pytest.raises(ValueError, match="'warp', expected one of threaded, mjx, chain"):
        dataclasses.replace(TINY, engine="warp")


def test_content_does_not_depend_on_the_shard_size(reference, tmp_path):
    other = generate(dataclasses.replace(TINY, shard_size=5), tmp_path / "data", progress=False)
    assert other.digest == open_store(reference).info().digest


def test_shares_of_two_processes_make_the_same_store(reference, tmp_path):
    first = generate(TINY, tmp_path / "data", progress=False, process_index=1, process_count=2)
    assert (first.n_complete, first.digest) == (4, None)
    assert generate(TINY, tmp_path / "data", progress=False, process_index=0, process_count=2).complete
    assert tree(tmp_path / "data") == tree(reference)
    with pytest.raises(ValueError, match="process_index is 2 and process_count 2"):
        generate(TINY, tmp_path / "data", process_index=2, process_count=2)


def test_a_disk_with_too_little_room_is_refused_before_anything_is_simulated(reference, tmp_path, monkeypatch):
    path, size = tmp_path / "data", 8 * (4 * 4 * 2 + 4 * 2 * 3 + 3 * 2 * 3) * 4  # float32 of the eight trajectories
    generate(TINY, path, progress=False, process_index=0, process_count=2)
    before = tree(path)

    def left(free):
        monkeypatch.setattr("shutil.disk_usage", lambda place: shutil._ntuple_diskusage(10**9, 10**9 - free, free))

    left(size // 3)
    with pytest.raises(ValueError, match=r"4 trajectories are missing in .*data, .* Make room"):
        generate(TINY, path, progress=False)
    assert tree(path) == before
    left(size)  # a store needs somewhat more than these arrays, but half of them are there
    assert generate(TINY, path, progress=False).complete and tree(path) == tree(reference)
    left(0)
    assert generate(TINY, path, progress=False).complete, "nothing is missing"


@pytest.mark.slow
def test_sigkill_and_resume_bit_for_bit(tmp_path):
    config = dataclasses.replace(TINY, n_trajectories=60, n_steps=20)
    whole = generate(config, tmp_path / "whole", progress=False)
    killed = tmp_path / "killed"
    process = child("generate(config, path, progress=False)", config, killed)
    deadline = time.monotonic() + 120
    while len(list(killed.glob("digest/c/*/0"))) < 3:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = open_store(killed).info()
    assert 6 <= before.n_complete < 60
    assert generate(config, killed, progress=False).digest == whole.digest
    assert tree(killed) == tree(tmp_path / "whole")


@dataclasses.dataclass(frozen=True)
class Interrupted(ThreadedEngine):
    """Presses Ctrl-C during the third rollout."""

    calls: list = dataclasses.field(default_factory=list, compare=False)

    def rollout(self, params, state, twist, interval=1.0):
        self.calls.append(len(twist))
        if len(self.calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return super().rollout(params, state, twist, interval)


@pytest.fixture
def listening():
    """Ctrl-C reaches Python: a shell starts what it runs in the background deaf to it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("listening")
def test_ctrl_c_keeps_what_is_done_and_says_how_to_go_on(reference, tmp_path):
    path = tmp_path / "data"
    with pytest.raises(GenerationInterrupted, match=r"Stopped at 4 of 8 .* again to resume"):
        generate(TINY, path, progress=False, engine=Interrupted(TINY.discretisation))
    assert open_store(path).info().n_complete == 4
    engine = Interrupted(TINY.discretisation)
    assert generate(TINY, path, progress=False, engine=engine).complete
    assert engine.calls == [2, 2]  # the two shards that were left, and nothing twice
    assert tree(path) == tree(reference)


@dataclasses.dataclass(frozen=True)
class Diverging(ThreadedEngine):
    """Loses the cables whose gripper 0 first moves by exactly one of the given speeds."""

    speeds: tuple = ()

    def rollout(self, params, state, twist, interval=1.0):
        final, trajectory = super().rollout(params, state, twist, interval)
        lost = np.isin(twist[:, 0, 0, 0], self.speeds)
        keypoints = np.where(lost[:, None, None, None], np.nan, trajectory.keypoints)
        return final, dataclasses.replace(trajectory, keypoints=keypoints)


def test_a_failed_trajectory_is_drawn_again_and_counted(reference, tmp_path):
    lost = [draw(TINY, 3), draw(TINY, 6), draw(TINY, 6, attempt=1)]
    engine = Diverging(TINY.discretisation, speeds=tuple(one.gripper_twist[0, 0, 0] for one in lost))
    info = generate(TINY, tmp_path / "data", progress=False, engine=engine)
    store = open_store(tmp_path / "data")
    block, usual = store.read(), open_store(reference).read()
    assert info.complete and info.attempts == 3
    np.testing.assert_array_equal(block.attempts, [0, 0, 0, 1, 0, 0, 2, 0])
    others = [0, 1, 2, 4, 5, 7]
    np.testing.assert_array_equal(block.keypoints[others], usual.keypoints[others])
    np.testing.assert_array_equal(block.gripper_twist[6], draw(TINY, 6, attempt=2).gripper_twist)


def test_a_trajectory_that_never_works_is_an_error_not_data(tmp_path):
    speeds = tuple(draw(TINY, 5, attempt).gripper_twist[0, 0, 0] for attempt in range(MAX_ATTEMPTS))
    with pytest.raises(
        ValueError, match=rf"failed {MAX_ATTEMPTS} times in a row; number 5: .*not finite.*mjx or chain, --t"
    ):
        generate(TINY, tmp_path / "data", progress=False, engine=Diverging(TINY.discretisation, speeds=speeds))
    assert open_store(tmp_path / "data").info().n_complete == 4  # shards 0 and 1


def test_faults_are_distinguished(reference):
    block = open_store(reference).read()
    one = dataclasses.replace(block, **{f.name: getattr(block, f.name)[0] for f in dataclasses.fields(block)})
    assert find_fault(TINY, one, ()) is None

    def spoil(scale):
        return dataclasses.replace(one, keypoints=one.keypoints * np.float32(scale))

    assert "not finite" in find_fault(TINY, spoil(np.nan), ())
    assert "from its gripper" in find_fault(TINY, spoil(1.1), ())
    middle = one.keypoints.copy()
    middle[:, 1] += np.float32(0.2)
    assert "stretched" in find_fault(TINY, dataclasses.replace(one, keypoints=middle), ())


def test_a_bias_of_keypoints_excuses_its_own_trajectories_alone(monkeypatch):
    """One draw of a posterior that moves keypoints must not let all others off."""
    bias = GivenEffect("keypoint_bias", VALUES["keypoint_bias"])
    config, asked = dataclasses.replace(TINY, posterior=((bias,), ())), {}

    def noted(config, one, effects):
        asked[len(asked)] = effects
        return find_fault(config, one, effects)

    monkeypatch.setattr(generation, "find_fault", noted)
    simulate(config, make_engine(config), [0])
    assert list(asked.values()) == [config.effects_of(row) for row in config.shard_rows(0)]
    assert {len(effects) for effects in asked.values()} == {0, 1}


def test_a_damaged_shard_is_not_made_again_by_other_packages(reference, tmp_path):
    path = tmp_path / "data"
    shutil.copytree(reference, path)
    meta = json.loads((path / "zarr.json").read_text())
    meta["attributes"]["versions"]["mujoco"] = "0.0.1"
    (path / "zarr.json").write_text(json.dumps(meta))
    assert generate(TINY, path, progress=False).complete
    victim = next(file for file in (path / "keypoints" / "c" / "1").rglob("*") if file.is_file())
    victim.write_bytes(victim.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"begun with other packages: mujoco is '0\.0\.1' in the store"):
        generate(TINY, path, progress=False)


def test_ends_off_the_grippers_are_a_fault_of_small_cables_too():
    """9 mm beside its grippers a cable of 5 cm is not held."""
    cable = Cable(length=0.05, diameter=0.001)
    config = dataclasses.replace(TINY, discretisation=dataclasses.replace(TINY.discretisation, cable=cable))
    points = np.zeros((2, cable.n_keypoints, 2), np.float32)
    points[..., 0] = 0.9 * cable.keypoint_arclength
    pose = np.concatenate([points[:, [0, -1]], np.zeros((2, 2, 1), np.float32)], axis=-1)
    one = Block(points, pose, np.zeros((1, 2, 3), np.float32), np.ones(3), np.zeros((), np.int32))
    assert find_fault(config, one, ()) is None
    beside = dataclasses.replace(one, keypoints=points + np.float32([0.0, 0.009]))
    assert "m from its gripper (allowed: 0.0005 m)" in (find_fault(config, beside, ()) or "")


@pytest.mark.slow
def test_four_processes_of_which_one_is_killed_and_started_again(tmp_path):
    config = dataclasses.replace(TINY, n_trajectories=64, n_steps=20)
    code = "generate(config, path, progress=False, process_index=int(sys.argv[3]), process_count=4)"
    path, killed = tmp_path / "data", 2
    processes = [child(code, config, path, str(p)) for p in range(4)]
    deadline = time.monotonic() + 900
    while not any((path / "digest" / "c" / str(shard) / "0").exists() for shard in range(killed, 32, 4)):
        assert processes[killed].poll() is None and time.monotonic() < deadline
        time.sleep(0.002)
    processes[killed].kill()
    processes[killed].communicate()
    made = sum(status == "complete" for status in map(open_store(path).status, range(killed, 32, 4)))
    assert 1 <= made < 8, "it was killed on its way"
    for process in [one for one in processes if one is not processes[killed]]:
        finish(process)
    assert open_store(path).info().n_complete == 48 + 2 * made
    finish(child(code, config, path, str(killed)))
    generate(config, tmp_path / "alone", progress=False)
    assert tree(path) == tree(tmp_path / "alone")


@pytest.mark.slow
def test_four_processes_of_jax_distributed_on_loopback(reference, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    code = (
        "import jax\n"
        "jax.distributed.initialize(sys.argv[3], num_processes=4, process_id=int(sys.argv[4]))\n"
        "info = generate(config, path, progress=False)\n"
        "print(jax.process_index(), jax.process_count(), info.complete, info.digest)\n"
    )
    processes = [child(code, TINY, tmp_path / "data", address, str(p), JAX_PLATFORMS="cpu") for p in range(4)]
    outputs = [finish(process) for process in processes]
    digest = open_store(reference).info().digest
    for p, output in enumerate(outputs):
        assert f"{p} 4 True {digest}" in output
    assert tree(tmp_path / "data") == tree(reference)


@pytest.mark.slow
def test_two_and_eight_devices_make_the_bytes_of_one(tmp_path):
    config = dataclasses.replace(TINY, engine="mjx", n_trajectories=7)
    code = "import jax\nprint(jax.local_device_count(), generate(config, path, progress=False).complete)\n"
    for count in (1, 2, 8):
        flags = f"--xla_force_host_platform_device_count={count}"
        output = finish(child(code, config, tmp_path / str(count), XLA_FLAGS=flags, JAX_PLATFORMS="cpu", NPROC="8"))
        assert f"{count} True" in output
    assert tree(tmp_path / "1") == tree(tmp_path / "2") == tree(tmp_path / "8")
    # and they are the trajectories of the other engine
    here = open_store(tmp_path / "1").read()
    block = simulate(config, ThreadedEngine(config.discretisation), range(config.n_shards))
    other = np.concatenate([part.keypoints for part in block])
    np.testing.assert_allclose(here.keypoints, other, atol=1e-3)


@pytest.mark.parametrize("shard_size, devices, at_once", [(2, 1, 4), (3, 2, 4), (8, 1, 1), (64, 1, 1)])
def test_an_accelerator_is_given_whole_shards(monkeypatch, shard_size, devices, at_once):
    config = dataclasses.replace(TINY, engine="chain", shard_size=shard_size)
    card = types.SimpleNamespace(platform="gpu")
    monkeypatch.setattr(generation.jax, "local_devices", lambda: [card] * devices)
    monkeypatch.setattr(generation, "CABLES_ON_ACCELERATOR", 8)
    engine = make_engine(config)
    assert shards_at_once(config, engine) == at_once and engine.width == at_once * shard_size


def test_motions_of_a_longer_cable_are_in_proportion():
    assert MotionConfig.for_length(1.0) == MotionConfig()
    drawn = []
    for length in (1.0, 1.5):
        config = Discretisation(Cable(length=length), n_links=13)
        drawn.append(random_motion(np.random.default_rng(3), config, 8, MotionConfig.for_length(length)))
    for short, long in zip(*drawn, strict=True):
        np.testing.assert_allclose(long, short * [1.5, 1.5, 1.0], atol=1e-9)


def test_unevenly_spaced_keypoints_are_no_fault(tmp_path):
    marks = (0.0, 0.05, 0.55, 1.0)
    config = dataclasses.replace(TINY, discretisation=Discretisation(Cable(n_keypoints=4, marks=marks), n_links=7))
    assert generate(config, tmp_path / "data", progress=False).n_complete == TINY.n_trajectories
    points = open_store(tmp_path / "data").read().keypoints
    chords = np.linalg.norm(np.diff(points, axis=2), axis=-1)
    assert (chords <= 1.02 * np.diff(marks)).all() and chords[..., 0].max() < 0.06 < chords[..., 1].min()
    assert open_store(tmp_path / "data").config.cable.marks == marks


def test_bounds_that_no_random_start_keeps_are_an_error_not_a_hang():
    motion = MotionConfig(start="random", min_distance=0.9995)
    with pytest.raises(ValueError, match=r"None of 10000 random starts keeps the bounds .* Widen them"):
        random_motion(np.random.default_rng(0), TINY.discretisation, 1, motion)


def test_a_straight_start_out_of_its_own_bounds_is_refused():
    with pytest.raises(ValueError, match="A straight start is out of the bounds"):
        random_motion(np.random.default_rng(0), Discretisation(), 5, MotionConfig(straight_slack=0.6))
