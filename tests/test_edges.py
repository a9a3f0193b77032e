"""Malformed inputs at every edge: each is answered by a result or a message of the package's own."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import pickle
import shutil
import socket
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import save

import edge_cases as edges
import test_dataset_store as stores
import test_perceive_recording as clouds
import test_recordings_bags as bags
import test_recordings_csv as tables
import test_robot as robots
from cablejax import cli
from cablejax.cable import Cable
from cablejax.cable_file import cable_text
from cablejax.commands import diagnose, runs
from cablejax.commands.resuming import Parts
from cablejax.control.link_state import Status
from cablejax.control.shaping import load_model
from cablejax.control.targets import Target, load_target, make_target
from cablejax.dataset import generate
from cablejax.dataset.opening import open_or_create, open_store
from cablejax.dataset.schema import digest_of_config
from cablejax.diagnose.recording import prepare
from cablejax.diagnose.verdict_json import verdict_json
from cablejax.dynamics import run_folder
from cablejax.gaplog import TARGETS, read_gap_log
from cablejax.perceive.recording import read_clouds
from cablejax.perceive.tracker import padded
from cablejax.recordings.bags import import_mcap
from cablejax.recordings.lerobot import write_lerobot
from cablejax.recordings.mcap_log import write_mcap
from cablejax.simulate import play
from cablejax.spatial.windows import windows_of
from cli_cases import made_up_run, small_model
from edge_cases import Accepted, answer, command
from recording_cases import swinging
from test_control_link import Harness
from test_diagnose_report import diagnosis
from test_log_geometry import log_of, motion


@dataclasses.dataclass(frozen=True)
class Edge:
    """A place where a user's file or option is read.

    Attributes:
        inputs: malformed ones in a quick run.
        edits: strategy of edits.
        attempt: `(folder, edit)`: writes the edited input into a folder and reads it.
    """

    inputs: int
    edits: st.SearchStrategy
    attempt: Callable[[pathlib.Path, Any], Any]


@functools.cache
def log_arrays() -> dict[str, Any]:
    log = log_of(*motion(samples=30))
    arrays = {f.name: getattr(log, f.name) for f in dataclasses.fields(log) if f.name != "meta"}
    return {**arrays, "meta": np.array(json.dumps(log.meta))}


@functools.cache
def original(name: str) -> pathlib.Path:
    """A valid input, which nobody changes; made once."""
    assert _TEMPORARY, "outside a test these would be left in the working folder"
    folder = pathlib.Path(_TEMPORARY) / name
    folder.mkdir(parents=True)
    if name == "model":
        small_model(folder)
    elif name == "store":
        shutil.rmtree(folder)
        stores.complete(open_or_create(folder, stores.SMALL))
    elif name == "bag":
        shutil.rmtree(folder)
        points = swinging(80)
        bags.write_bag(folder, points, bags.grippers_of(points), bags.StoragePlugin.MCAP)
    return folder


@functools.cache
def target() -> Target:
    return make_target("U")


_TEMPORARY = ""


@pytest.fixture(scope="module", autouse=True)
def place(tmp_path_factory):
    """Where valid inputs are, and stand-ins for the long part of each command."""
    global _TEMPORARY
    _TEMPORARY = str(tmp_path_factory.mktemp("original"))

    def stop(*given, **named):
        raise Accepted(*given)

    def diagnosed(log, *_, bounds=None, **__):
        raise Accepted(windows_of(log) if log.keypoints.shape[-1] == 3 else prepare(log), bounds)

    played = play.played

    def begun(plant, start, twist, interval, **named):
        raise Accepted(played(plant, start, twist[:2], interval, **named))

    from cablejax.dynamics import train

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate, "generate", stop)
        patch.setattr(train, "train", lambda config, *_, **__: stop(config))
        patch.setattr(runs, "shape_and_report", lambda job, *_, **__: stop(job.plant, job.targets, job.camera))
        patch.setattr(diagnose, "diagnose_and_report", diagnosed)
        patch.setattr(play, "played", begun)
        # what is imported and compiled once is no part of an answer
        with pytest.MonkeyPatch.context() as first:
            first.setattr("edge_cases.ANSWER", 600.0)
            load_model(str(original("model")))
            diagnose_arrays(original("log"), [])
            motion_arrays(original("motion"), [])
        with tempfile.TemporaryDirectory() as out, contextlib.suppress(Accepted):
            cli.main(["study", "--out", f"{out}/study"])
        yield
    original.cache_clear()


def diagnose_arrays(folder, edit):
    (folder / "log.npz").write_bytes(edges.edited_archive(log_arrays(), edit))
    return command("diagnose", folder / "log.npz", "--out", folder / "out")


def diagnose_meta(folder, edit):
    meta = edges.edited_tree(json.loads(str(log_arrays()["meta"])), edit)
    np.savez(folder / "log.npz", **{**log_arrays(), "meta": np.array(json.dumps(meta))})
    return command("diagnose", folder / "log.npz", "--out", folder / "out")


def diagnose_bytes(folder, edit):
    np.savez(folder / "whole.npz", **log_arrays())
    (folder / "log.npz").write_bytes(edges.edited_bytes((folder / "whole.npz").read_bytes(), edit))
    return command("diagnose", folder / "log.npz", "--out", folder / "out")


def cable_words(folder, edit):
    (folder / "cable.toml").write_bytes(edges.edited_words(cable_text(Cable()), edit).encode("utf-8", "surrogatepass"))
    return command("cable", "--from", folder / "cable.toml")


def target_arrays(folder, edit):
    content = edges.edited_archive({"keypoints": target().keypoints, "gripper_pose": target().gripper_pose}, edit)
    (folder / "t.npz").write_bytes(content)
    return answer(lambda: load_target(folder / "t.npz"))


def target_json(folder, edit):
    tree = {"keypoints": target().keypoints.tolist(), "gripper_pose": target().gripper_pose.tolist()}
    (folder / "t.json").write_text(json.dumps(edges.edited_tree(tree, edit)))
    return answer(lambda: load_target(folder / "t.json"))


def target_csv(folder, edit):
    text = "x,y\n" + "\n".join(f"{x},{y}" for x, y in target().keypoints)
    (folder / "t.CSV").write_bytes(edges.edited_bytes(text.encode(), edit))
    return answer(lambda: load_target(folder / "t.CSV"))


def import_table(folder, edit):
    which, changes = edit
    table, layout = ((tables.in_space, tables.PAIRS), (tables.in_the_plane, tables.PLANAR))[which[1]]
    path, other = tables.written(folder, table(), layout)
    edited = (path, other)[which[0]]
    edited.write_bytes(edges.edited_words(edited.read_text(), changes).encode("utf-8", "surrogatepass"))
    done = command("import", "csv", path, "--layout", other, "--out", folder / "log.npz")
    return done if done is None else command("diagnose", folder / "log.npz", "--out", folder / "out")


def import_deform(folder, edit):
    arrays = {"keypoints": swinging(60)[None], "dt": 0.01, "split": ["train"], "source_id": [1], "recording_guess": [1]}
    (folder / "a.npz").write_bytes(edges.edited_archive(arrays, edit))
    return command("import", "deform", folder / "a.npz", "--out", folder / "log.npz")


def import_pickle(folder, edit):
    content = pickle.dumps(swinging(60).transpose(0, 2, 1))
    (folder / "1.pkl").write_bytes(edges.edited_bytes(content, edit))
    return command("import", "deform", folder / "1.pkl", "--out", folder / "log.npz")


def import_bag(folder, edit):
    shutil.copytree(original("bag"), folder / "bag")
    file = sorted((folder / "bag").iterdir())[edit[0][1] % 2 if edit else 0]
    file.write_bytes(edges.edited_bytes(file.read_bytes(), edit))
    (folder / "layout.toml").write_text(bags.LAYOUT)
    return answer(lambda: import_mcap(folder / "bag", folder / "layout.toml"))


def seen(path):
    sequence = read_clouds(path)
    return sequence.time, sequence.gripper_pose, [padded(cloud, 100).points for cloud in sequence.clouds]


def cloud_arrays(folder, edit):
    arrays = {"time": clouds.TIME, "gripper_pose": clouds.POSES, "points": clouds.POINTS, "count": np.array([4, 0, 3])}
    (folder / "c.npz").write_bytes(edges.edited_archive(arrays, edit))
    return answer(lambda: seen(folder / "c.npz"))


def cloud_folder(folder, edit):
    kind, changes = edit
    clouds.folder(folder, kind)
    file = sorted(folder.iterdir())[changes[0][0] % 4 if changes else 0]
    text = edges.edited_words(file.read_bytes().decode("latin1"), changes)
    file.write_bytes(text.encode("latin1", "replace"))
    return answer(lambda: seen(folder))


def store_files(folder, edit):
    """The files of a store, with a digest of its configuration that fits again."""
    path = folder / "store"
    shutil.copytree(original("store"), path)
    which, tree, raw = edit
    files = sorted(file for file in path.rglob("*") if file.is_file())
    described = [file for file in files if file.name == "zarr.json"]
    if raw is None:
        file = described[which % len(described)]
        content = edges.edited_tree(json.loads(file.read_text()), tree)
        if isinstance(content, dict) and isinstance(content.get("attributes"), dict):
            content["attributes"]["config_digest"] = digest_of_config(content["attributes"].get("config"))
        file.write_text(json.dumps(content))
    else:
        file = files[which % len(files)]
        file.write_bytes(edges.edited_bytes(file.read_bytes(), raw))
    read = answer(lambda: open_store(path).read())
    again = answer(lambda: stores.complete(open_or_create(path, stores.SMALL)))
    if again is not None:  # the same generation mends what it does not refuse
        assert open_store(path).info().complete and len(open_store(path).read()) == 7
    return read


def weights_file(folder, edit):
    tree, raw = edit
    file = original("model") / "weights.safetensors"
    content = file.read_bytes()
    if raw is None:
        with safe_open(file, framework="numpy") as whole:
            text = whole.metadata()["cablejax"]
            tensors = {name: whole.get_tensor(name) for name in whole.keys()}  # noqa: SIM118
        content = save(tensors, metadata={"cablejax": json.dumps(edges.edited_tree(json.loads(text), tree))})
    else:
        content = edges.edited_bytes(content, raw)
    (folder / "w.safetensors").write_bytes(content)
    answer(lambda: load_model(str(folder / "w.safetensors")).cable)


VERDICT = {
    "schema": "cablejax-verdict/1",
    "verdict": "named",
    "effects": [{"name": "bending_stiffness", "parameters": {"ratio": {"value": 2.0}}}],
    "posterior": [
        [{"name": "bending_stiffness", "parameters": {"ratio": 1.8}}],
        [
            {"name": "table_friction", "parameters": {"coefficient": 0.5}},
            {"name": "viscous_drag", "parameters": {"coefficient_n_s_per_m2": 2.0}},
        ],
    ],
}


def verdict_file(folder, edit):
    (folder / "v.json").write_text(json.dumps(edges.edited_tree(VERDICT, edit)))
    return command("simulate", "--engine", "chain", "--with", folder / "v.json", "--out", folder / "data")


BOUNDS = """
workspace_m = [[-1.0, -1.0], [1.0, 1.0]]
keep_out_m = [[0.0, 0.8, 0.1]]
speed_m_per_s = 0.05
turn_rate_rad_per_s = 0.3
min_distance_m = 0.2
max_distance_m = 0.9
bend_radius_m = 0.04
duration_s = 20
"""


def bounds_words(folder, edit):
    (folder / "b.toml").write_bytes(edges.edited_words(BOUNDS, edit).encode("utf-8", "surrogatepass"))
    log = original("log") / "log.npz"
    return command("diagnose", log, "--bounds", folder / "b.toml", "--out", folder / "out")


def motion_arrays(folder, edit):
    """Lays the cable out and plays the first command of each motion that is accepted."""
    arrays = log_arrays()
    step = np.diff(arrays["gripper_pose"], axis=1) / np.diff(arrays["time"], axis=1)[..., None, None]
    twist = np.concatenate([step, 0.0 * step[:, -1:]], axis=1).astype(np.float32)
    (folder / "motion.npz").write_bytes(edges.edited_archive({**arrays, "gripper_command": twist}, edit))
    return command("shape", "--motion", folder / "motion.npz", "--links", "8", "--out", folder / "out")


def diagnose_two(folder, edit):
    tree, arrays = edit
    meta = edges.edited_tree(json.loads(str(log_arrays()["meta"])), tree)
    later = {**log_arrays(), "keypoints": log_arrays()["keypoints"] + np.float32(1e-3)}
    (folder / "b.npz").write_bytes(edges.edited_archive({**later, "meta": np.array(json.dumps(meta))}, arrays))
    return command("diagnose", original("log") / "log.npz", folder / "b.npz", "--out", folder / "out")


def robot_lines(folder, edit):
    """A robot with a damaged message gets replies within the limits, and a log or a reason."""
    which, tree, raw = edit
    harness, lines = Harness(), []
    for k in range(20):
        lines += [
            robots.robot_soak.observation_line(harness.seen(0.1 * k)),
            json.dumps({"now": 0.1 * k}).encode() + b"\n",
        ]
    line = lines[which % len(lines)]
    damaged = json.dumps(edges.edited_tree(json.loads(line), tree)).encode() + b"\n"
    lines[which % len(lines)] = damaged if raw is None else edges.edited_bytes(line, raw)

    def talk():
        robot = robots.Client(robots.run_to(folder / "log.npz", rest=0.5), simulated_clock=True)
        with contextlib.suppress(ConnectionError):  # the server may have left
            robot.say(*lines)
            robot.socket.shutdown(socket.SHUT_WR)
            for reply in map(json.loads, robot.lines):
                assert np.abs(reply["twist"]).max() <= 0.011 and reply["status"] in list(Status)
                assert all(10 < len(reason) < 3000 for reason in reply["refused"])
        ended = robot.leave()
        if isinstance(ended, Exception):
            raise ended
        read_gap_log(ended)

    answer(talk)


def view_files(folder, edit):
    """The page of anything whose bytes are damaged."""
    which, raw = edit
    files = {
        "cable.toml": lambda: cable_text(Cable()).encode(),
        "log.npz": lambda: (original("log") / "log.npz").read_bytes(),
        "w.safetensors": lambda: (original("model") / "weights.safetensors").read_bytes(),
        "v.json": lambda: json.dumps(verdict_json(diagnosis())).encode(),
    }
    name = sorted(files)[which]
    (folder / name).write_bytes(edges.edited_bytes(files[name](), raw))
    return command("view", folder / name)


def view_verdict(folder, edit):
    content = edges.edited_tree(verdict_json(diagnosis()), edit)
    (folder / "v.json").write_text(json.dumps(content))
    return command("view", folder / "v.json")


def view_meta(folder, edit):
    meta = edges.edited_tree(json.loads(str(log_arrays()["meta"])) | {TARGETS: [target().keypoints.tolist()] * 2}, edit)
    np.savez(folder / "log.npz", **{**log_arrays(), "meta": np.array(json.dumps(meta))})
    return command("view", folder / "log.npz")


def import_exported(folder, edit):
    """A damaged file of an exported log is refused, or its log is a log."""
    which, raw = edit
    write_mcap(folder / "log.mcap", read_gap_log(original("log") / "log.npz"))
    write_lerobot(folder / "set", read_gap_log(original("log") / "log.npz"))
    files = [folder / "log.mcap", *sorted(file for file in (folder / "set").rglob("*") if file.is_file())]
    file = files[which % len(files)]
    file.write_bytes(edges.edited_bytes(file.read_bytes(), raw))
    form, source = ("mcap", file) if file == files[0] else ("lerobot", folder / "set")
    return command("import", form, source, "--out", folder / "back.npz")


def kept_files(folder, edit):
    """What an unfinished command kept is used, made again, or refused."""
    which, raw = edit
    settings_ = {"steps": 2}
    parts = Parts(folder / "parts", settings_)
    parts.begin()
    parts.save("U-direct", made_up_run(target()))
    run_folder.claim_folder(folder / "train", {"config": {}, "data": "a"}, overwrite=False)
    file = (parts.folder / "settings.json", parts.folder / "U-direct.run.npz", folder / "train" / "run.json")[which]
    file.write_bytes(edges.edited_bytes(file.read_bytes(), raw))
    answer(lambda: Parts(folder / "parts", settings_).differing())
    answer(lambda: parts.load("U-direct") and None)
    answer(lambda: run_folder.claim_folder(folder / "train", {"config": {}, "data": "a"}, overwrite=False))


OPTIONS = {
    "simulate": "--trajectories --steps --max-amplification --links --timestep --seed --stiffness-range --effect "
    "--cable --with --out --process-count --process-index --device",
    "train": "--lr --held-out --steps --batch --latent --message-passing --seed --start-from",
    "shape": "--steps --noise-mm --links --seed --target --weights --plant-effect --cable --solver",
    "cable": "--from --out",
    "bench simulate": "--batch --seconds --rounds --threads --links",
    "diagnose": "--out --commissioning --only --bounds --device",
    "study": "--rounds --noise-mm --links --bounds --cable --plant-effect --out --seed",
    "view": "--out",
}
WORDS = (
    "0", "-1", "1", "99999999999999999999", "9" * 5000, "1e308", "-1e30", "1e-30", "nan", "inf", "", "x", "1.5",
    "/dev/zero", "/", "a.npz", "a.toml", "a.html", "none:", "bending_stiffness:ratio=1e308",
    "bending_stiffness:ratio=nan", "bending_stiffness", ":=,", "\udc80", "cpu", "--",
)  # fmt: skip


def options(folder, edit):
    which, chosen = edit
    name = sorted(OPTIONS)[which]
    names = OPTIONS[name].split()
    arguments = []
    for option, word, second in chosen:
        flag = names[option % len(names)]
        arguments += [flag, WORDS[word]] + ([WORDS[second]] if flag.endswith("-range") else [])
    fixed: dict[str, list] = {
        "train": ["--data", original("store"), "--out", folder / "out"],
        "shape": ["--weights", original("model"), "--out", folder / "out"],
        "bench simulate": ["--rounds", "0"],  # what is accepted would be timed
        "diagnose": [original("log") / "log.npz"],
        "view": [original("log") / "log.npz"],
    }
    before = os.getcwd()
    os.chdir(folder)
    try:
        return command(*name.split(), *arguments, *fixed.get(name, []))
    finally:
        os.chdir(before)


pair = st.tuples
EDGES = {
    "log arrays": Edge(240, edges.ARRAYS, diagnose_arrays),
    "log meta": Edge(200, edges.TREE, diagnose_meta),
    "log bytes": Edge(80, edges.BYTES, diagnose_bytes),
    "cable file": Edge(180, edges.WORDS, cable_words),
    "target npz": Edge(120, edges.ARRAYS, target_arrays),
    "target json": Edge(160, edges.TREE, target_json),
    "target csv": Edge(60, edges.BYTES, target_csv),
    "csv": Edge(160, pair(pair(st.integers(0, 1), st.integers(0, 1)), edges.WORDS), import_table),
    "deform": Edge(80, edges.ARRAYS, import_deform),
    "pickle": Edge(60, edges.BYTES, import_pickle),
    "bag": Edge(30, edges.BYTES, import_bag),
    "cloud npz": Edge(120, edges.ARRAYS, cloud_arrays),
    "cloud folder": Edge(120, pair(st.sampled_from(("ascii", "binary")), edges.WORDS), cloud_folder),
    "store": Edge(60, pair(st.integers(0, 100), edges.TREE, st.none() | edges.BYTES), store_files),
    "weights": Edge(60, pair(edges.TREE, st.none() | edges.BYTES), weights_file),
    "verdict": Edge(120, edges.TREE, verdict_file),
    "bounds": Edge(100, edges.WORDS, bounds_words),
    "motion": Edge(60, edges.ARRAYS, motion_arrays),
    "two logs": Edge(60, pair(edges.TREE, st.just([]) | edges.ARRAYS), diagnose_two),
    "robot lines": Edge(100, pair(st.integers(0, 39), edges.TREE, st.none() | edges.BYTES), robot_lines),
    "view files": Edge(40, pair(st.integers(0, 3), edges.BYTES), view_files),
    "view verdict": Edge(30, edges.TREE, view_verdict),
    "view log": Edge(30, edges.TREE, view_meta),
    "exported": Edge(40, pair(st.integers(0, 100), edges.BYTES), import_exported),
    "kept": Edge(60, pair(st.integers(0, 2), edges.BYTES), kept_files),
    "options": Edge(
        200,
        pair(
            st.integers(0, len(OPTIONS) - 1),
            st.lists(pair(st.integers(0, 8), *[st.integers(0, len(WORDS) - 1)] * 2), min_size=1, max_size=2),
        ),
        options,
    ),
}


UNEDITED: dict[str, Any] = {
    "csv": ((0, 1), []),
    "cloud folder": ("ascii", []),
    "store": (0, [], None),
    "two logs": ([], []),
    "view files": (1, []),
    "exported": (0, []),
}
"""The edits that change nothing, where that is not an empty list of them."""
SILENT = "weights", "robot lines", "kept", "options"
"""Places that return nothing, or take no file."""


@pytest.mark.parametrize("name", [name for name in EDGES if name not in SILENT])
def test_what_is_not_damaged_is_accepted(name, tmp_path):
    """Or nothing behind its first refusal would ever be tried."""
    assert EDGES[name].attempt(tmp_path, UNEDITED.get(name, [])) is not None


def fuzz(edge: Edge, inputs: int, folder: pathlib.Path) -> None:
    @settings(
        max_examples=inputs, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    @given(edge.edits)
    def attempt(edit):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        edge.attempt(folder, edit)

    attempt()


@pytest.mark.parametrize("name", EDGES)
def test_malformed_input_is_answered(name, tmp_path):
    fuzz(EDGES[name], EDGES[name].inputs, tmp_path / "input")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", EDGES)
def test_much_more_malformed_input_is_answered(name, tmp_path):
    fuzz(EDGES[name], 10 * EDGES[name].inputs, tmp_path / "input")


def test_two_thousand_inputs_are_tried():
    assert sum(edge.inputs for edge in EDGES.values()) >= 2000
