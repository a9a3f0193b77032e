"""Gap logs as MCAP files, LeRobot data sets and Rerun recordings: other readers read them, and ours the same log."""

import base64
import dataclasses
import importlib
import json
import sys

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.cli import main
from cablejax.gaplog import (
    TARGETS,
    Episode,
    GapLogError,
    episodes_of,
    gap_log_from_episodes,
    read_gap_log,
    read_simulated,
    targets_of,
    write_gap_log,
)
from cablejax.gaplog_join import joined
from cablejax.poses import poses_from_markers, twists
from cablejax.recordings.lerobot import read_lerobot, write_lerobot
from cablejax.recordings.mcap_log import read_mcap, write_mcap
from cablejax.types import GapLog
from file_cases import with_other_bytes
from recording_cases import DT, swinging
from test_log_geometry import motion

FORMATS = {"mcap": (write_mcap, read_mcap, "log.mcap"), "lerobot": (write_lerobot, read_lerobot, "set")}


def needs(library: str):
    return pytest.importorskip(library, reason=f"{library} is not installed: pip install 'cablejax[recordings,rerun]'")


def planar() -> GapLog:
    """Two episodes of unequal length with a target, marks that were not observed, and an angle beyond a turn."""
    points, pose = motion(heading=20.0)
    points = points.copy()
    points[3, 4] = np.nan
    points[:, 7] = np.nan
    episodes = []
    for n, name in ((12, "approach_u"), (9, "return to $U$")):
        command = np.random.default_rng(n).normal(size=(n, 2, 3)).astype(np.float32)
        command[-1] = np.nan  # held for no sample
        time = 0.1 * np.arange(n) + 1e-9 * np.arange(n) ** 2
        episodes.append(Episode(name, time, points[:n], pose[:n], command, hold=np.arange(n) < 3))
    target = motion(heading=20.0)[0][-1].tolist()
    return gap_log_from_episodes(episodes, Cable(), source="test", extra={TARGETS: [target, None], "take": ["a", "b"]})


def in_space() -> GapLog:
    """One episode in space, without a word on when the grippers rest."""
    points = swinging(40)
    pairs = ((0, 1, 0), (7, 8, 8))
    pose = np.stack([poses_from_markers(points[:, a], points[:, b], points[:, at]) for a, b, at in pairs], axis=1)
    time = DT * np.arange(40)
    episode = Episode("swing", time, points, pose, twists(time, pose), np.zeros(40, bool))
    cable = Cable(n_keypoints=9, friction_coefficient=0.0)
    return dataclasses.replace(gap_log_from_episodes([episode], cable, source="test"), hold=None)


LOGS = {"planar": planar, "in space": in_space}


def assert_same(log: GapLog, other: GapLog) -> None:
    """Bit for bit, but for what the padding holds."""
    assert log.meta == other.meta and (log.hold is None) == (other.hold is None)
    np.testing.assert_array_equal(log.episode_length, other.episode_length)
    for name in ("time", "keypoints", "gripper_pose", "gripper_command", "hold"):
        a, b = getattr(log, name), getattr(other, name)
        if a is not None:
            assert a.dtype == b.dtype
            for e, n in enumerate(log.episode_length):
                np.testing.assert_array_equal(a[e, :n], b[e, :n], err_msg=name)


@pytest.mark.parametrize("log", LOGS.values(), ids=LOGS)
@pytest.mark.parametrize("name", FORMATS)
def test_a_log_comes_back_through_the_commands(name, log, tmp_path, capsys):
    needs("mcap" if name == "mcap" else "pyarrow")
    file = FORMATS[name][2]
    write_gap_log(tmp_path / "log.npz", log())
    assert main(["export", name, str(tmp_path / "log.npz"), "--out", str(tmp_path / file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"] == log().episode_length.sum()
    assert main(["import", name, str(tmp_path / file), "--out", str(tmp_path / "back.npz")]) == 0
    assert_same(log(), read_gap_log(tmp_path / "back.npz"))
    assert main(["export", name, str(tmp_path / "log.npz"), "--out", str(tmp_path / file)]) == 2
    assert "exists" in capsys.readouterr().err


def test_mcap_is_read_by_its_own_reader(tmp_path):
    reader = needs("mcap.reader")
    log = planar()
    with write_mcap(tmp_path / "log.mcap", log).open("rb") as stream:
        found = reader.make_reader(stream, validate_crcs=True)
        summary = found.get_summary()
        schemas = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
        messages = [(channel.topic, m.log_time, json.loads(m.data)) for _, channel, m in found.iter_messages()]
    assert {topic: schema.name for topic, schema in schemas.items()} == {
        "/cable/keypoints": "foxglove.PointCloud",
        "/grippers/pose": "foxglove.PosesInFrame",
        "/grippers/sample": "cablejax.Sample",
    }
    for topic, _, message in messages:
        fields = json.loads(schemas[topic].data)
        assert fields["type"] == "object" and set(message) <= set(fields["properties"])
    assert summary.statistics.message_count == 3 * 21 == len(messages)
    clouds = [(stamp, message) for topic, stamp, message in messages if topic == "/cable/keypoints"]
    times = np.concatenate([log.time[0, :12], 1.0 + log.time[0, 11] + log.time[1, :9]])
    np.testing.assert_allclose([stamp for stamp, _ in clouds], 1e9 * times, rtol=0, atol=1.0)
    points = np.stack([np.frombuffer(base64.b64decode(m["data"]), "<f4").reshape(-1, 3) for _, m in clouds[:12]])
    np.testing.assert_array_equal(points[..., :2], log.keypoints[0])
    pose = next(message["poses"][1] for topic, _, message in messages if topic == "/grippers/pose")
    turn = 2 * np.arctan2(pose["orientation"]["z"], pose["orientation"]["w"])
    assert np.cos(turn - log.gripper_pose[0, 0, 1, 2]) == pytest.approx(1.0, abs=1e-9)


def test_lerobot_has_the_layout_of_its_own_data_sets(tmp_path):
    needs("pyarrow")
    parquet = importlib.import_module("pyarrow.parquet")
    log = planar()
    folder = write_lerobot(tmp_path / "set", log)
    info, stats = (json.loads((folder / "meta" / f"{name}.json").read_text()) for name in ("info", "stats"))
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 10, 2, 21)
    data = parquet.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(data.column_names) == set(info["features"]) == set(stats)
    for name, feature in info["features"].items():
        of = data.schema.field(name).type
        kind = of if feature["shape"] == [1] else of.value_type
        assert str(kind) == {"float32": "float", "float64": "double"}.get(feature["dtype"], feature["dtype"])
        assert feature["shape"] == [1] or of.list_size == feature["shape"][0] == len(feature["names"])
        assert len(stats[name]["mean"]) == feature["shape"][0] and stats[name]["count"] == [21]
    state = np.concatenate([log.gripper_pose[0], log.gripper_pose[1, :9]]).reshape(21, -1)
    np.testing.assert_allclose(stats["observation.state"]["max"], state.max(axis=0))
    assert stats["observation.environment_state"]["max"][14] == 0.0  # never observed
    rows = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(r["dataset_from_index"], r["dataset_to_index"], r["length"]) for r in rows] == [(0, 12, 12), (12, 21, 9)]
    assert [row["tasks"] for row in rows] == [["approach_u"], ["return to $U$"]]
    tasks = parquet.read_table(folder / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    assert tasks.to_pydict() == {"task_index": [0, 1], "__index_level_0__": ["approach_u", "return to $U$"]}


def test_lerobot_splits_are_those_of_the_log(tmp_path):
    """All episodes were for training, those of the eval split too."""
    needs("pyarrow")
    log = planar()
    for split, expected in (
        (None, {"train": "0:2"}),
        (["", "eval"], {"train": "0:1", "eval": "1:2"}),
        (["eval", "eval"], {"eval": "0:2"}),
    ):
        meta = log.meta if split is None else {**log.meta, "split": split}
        folder = write_lerobot(tmp_path / f"{len(expected)}{split}", dataclasses.replace(log, meta=meta))
        assert json.loads((folder / "meta/info.json").read_text())["splits"] == expected
    four = joined([log, dataclasses.replace(log, keypoints=log.keypoints + 1e-3)], ["one", "other"])
    mixed = dataclasses.replace(four, meta={**four.meta, "split": ["train", "eval", "train", ""]})
    folder = write_lerobot(tmp_path / "mixed", mixed)
    assert json.loads((folder / "meta/info.json").read_text())["splits"] == {"all": "0:4"}


def test_lerobot_is_read_by_reruns_reader(tmp_path):
    needs("pyarrow")
    reader = needs("rerun.experimental")
    log = in_space()
    found = reader.LeRobotReader(write_lerobot(tmp_path / "set", log))
    assert found.version == "v3" and found.episodes() == [0]
    chunks = {(c.entity_path, c.num_rows): c.to_record_batch() for c in found.stream(0)}
    states = np.stack(chunks["/observation.state", 40]["Scalars:scalars"].to_pylist())
    np.testing.assert_array_equal(states.astype(np.float32), log.gripper_pose[0].reshape(40, -1))


def rerun_rows(path) -> dict:
    """Of each entity and component the static value, or the seconds and the values."""
    found = {}
    for chunk in needs("rerun.chunk").RrdReader(path).stream():
        rows = chunk.to_record_batch()
        time = None if chunk.is_static else rows["time"].cast("int64").to_numpy() * 1e-9
        for name in rows.schema.names:
            if ":" in name:
                found[chunk.entity_path, name] = (time, rows[name].to_pylist())
    return found


def test_rerun_reads_its_recordings_back(tmp_path):
    needs("rerun")
    from cablejax.report.rerun_file import write_rerun

    log = planar()
    nominal = log.keypoints + np.float32(0.02) * np.array([1.0, 0.0], np.float32)
    found = rerun_rows(write_rerun(tmp_path / "run.rrd", log, simulated={"nominal": nominal}, about="# About"))
    time, points = found["/0_approach_u/keypoints", "Points3D:positions"]
    np.testing.assert_allclose(time, log.time[0], atol=1e-9)
    assert [len(row) for row in points] == [12, 12, 12, 11, *[12] * 8]  # of 13, one was never observed
    seen = np.isfinite(log.keypoints[0, 0]).all(axis=-1)
    np.testing.assert_array_equal(np.array(points[0])[:, :2], log.keypoints[0, 0][seen])
    _, moved = found["/1_return_to_U_/gripper_1", "Transform3D:translation"]
    np.testing.assert_array_equal(np.array(moved)[:, 0, :2], log.gripper_pose[1, :9, 1, :2])
    _, target = found["/0_approach_u/target", "LineStrips3D:strips"]
    np.testing.assert_allclose(np.array(target[0][0])[:, :2], targets_of(log)[0], atol=1e-6)
    assert ("/1_return_to_U_/target", "LineStrips3D:strips") not in found
    _, error = found["/0_approach_u/error_cm/nominal", "Scalars:scalars"]
    np.testing.assert_allclose(np.ravel(error), 2.0, atol=1e-4)
    _, error = found["/0_approach_u/error_cm/target", "Scalars:scalars"]
    assert error[0][0] > 5.0 and error[-1][0] == pytest.approx(0.0, abs=1e-4)
    assert found["/about", "TextDocument:text"][1] == [["# About"]]


@pytest.mark.parametrize("length", [0.3, 3.0])
def test_rerun_draws_grippers_and_keypoints_in_proportion_to_the_cable(length, tmp_path):
    needs("rerun")
    from cablejax.report.rerun_file import write_rerun

    log = planar()
    log.meta["cable"]["length_m"] = length
    found = rerun_rows(write_rerun(tmp_path / "run.rrd", log))
    arrow = found["/0_approach_u/gripper_0", "Arrows3D:vectors"][1]
    radius = found["/0_approach_u/keypoints", "Points3D:radii"][1]
    assert np.ravel(arrow)[0] == pytest.approx(0.06 * length) and np.ravel(radius)[0] == pytest.approx(0.004 * length)


def test_a_diagnosis_is_exported_with_what_it_simulated(tmp_path, capsys):
    needs("rerun")
    from cablejax.report.diagnosis_page import write_diagnosis_page
    from test_diagnose_report import diagnosis

    made = diagnosis()
    write_diagnosis_page(made, tmp_path / "report")
    log = read_gap_log(tmp_path / "report" / "simulated.npz")
    simulated = read_simulated(tmp_path / "report" / "simulated.npz", log)
    np.testing.assert_allclose(simulated["nominal"], made.nominal, atol=1e-6)
    assert main(["export", "rerun", str(tmp_path / "report"), "--out", str(tmp_path / "run.rrd"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["simulated"] == ["nominal", "explained"]
    found = rerun_rows(tmp_path / "run.rrd")
    error = np.ravel(found["/0_approach/error_cm/nominal", "Scalars:scalars"][1])
    # a gap of 4 mm in the middle of the cable and 1 mm of noise, in each coordinate
    share = np.sin(np.pi * np.linspace(0.0, 1.0, 13)) ** 2
    assert error.mean() == pytest.approx(0.1 * np.sqrt(2 * (16 * share.mean() + 1)), abs=0.01)
    assert made.sentence in found["/about", "TextDocument:text"][1][0][0]


@pytest.mark.parametrize("name", FORMATS)
def test_without_its_library_a_format_names_the_extra(name, tmp_path, monkeypatch):
    for library in ("mcap", "mcap.writer", "mcap.reader", "pyarrow"):
        monkeypatch.setitem(sys.modules, library, None)
    write, read, file = FORMATS[name]
    for attempt in (lambda: write(tmp_path / file, planar()), lambda: read(tmp_path / file)):
        with pytest.raises(ValueError, match=r"pip install 'cablejax\[recordings\]'"):
            attempt()


def test_without_rerun_its_extra_is_named(tmp_path, monkeypatch):
    from cablejax.report.rerun_file import write_rerun

    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ValueError, match=r"pip install 'cablejax\[rerun\]'"):
        write_rerun(tmp_path / "run.rrd", planar())


def test_a_damaged_mcap_file_is_answered(tmp_path):
    needs("mcap")
    whole = write_mcap(tmp_path / "log.mcap", planar()).read_bytes()
    for broken in [*with_other_bytes(whole, 60), whole[: len(whole) // 2], b""]:
        (tmp_path / "log.mcap").write_bytes(broken)
        try:
            assert_same(read_mcap(tmp_path / "log.mcap"), planar())
        except ValueError as error:
            assert "log.mcap" in str(error)


def test_an_mcap_file_with_another_cable_than_was_written_is_refused(tmp_path):
    needs("mcap")
    path = write_mcap(tmp_path / "log.mcap", planar())
    whole = path.read_bytes()
    stated = b'"diameter_m": 0.01'
    assert whole.count(stated) == 1
    path.write_bytes(whole.replace(stated, stated[:-1] + b"2"))
    with pytest.raises(GapLogError, match=r"log.mcap could not be read \(CRCValidationError"):
        read_mcap(path)


def test_a_damaged_data_set_is_answered(tmp_path):
    needs("pyarrow")
    folder = write_lerobot(tmp_path / "set", planar())
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        whole = file.read_bytes()
        for broken in [*with_other_bytes(whole, 12), whole[: len(whole) // 2], b"", b"[]", b"{}"]:
            file.write_bytes(broken)
            try:
                found = read_lerobot(folder)
            except ValueError as error:
                assert "set" in str(error)
            else:
                if file.is_relative_to(folder / "data"):
                    assert_same(found, planar())
        file.write_bytes(whole)
    assert_same(read_lerobot(folder), planar())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.slice(0, len(table) - 2), r"has \d+ rows, but .* states \d+: rows were lost or added"),
        (lambda table: table.drop(["hold"]), r"lacks hold, which meta/info.json states"),
        (lambda table: with_column(table, "hold", ["False"] * len(table)), r"hold has object, expected true or false"),
        (
            lambda table: with_column(table, "episode_index", [9] * len(table)),
            r"rows of episode 9, but .*counted from 0",
        ),
    ],
)
def test_a_data_set_with_other_rows_or_columns_is_refused(change, message, tmp_path):
    needs("pyarrow")
    import pyarrow.parquet

    folder = write_lerobot(tmp_path / "set", planar())
    data = folder / "data/chunk-000/file-000.parquet"
    pyarrow.parquet.write_table(change(pyarrow.parquet.read_table(data)), data)
    with pytest.raises(GapLogError, match=message):
        read_lerobot(folder)


def with_column(table, name, values):
    import pyarrow

    return table.set_column(table.column_names.index(name), name, pyarrow.array(values))


def test_files_of_other_programs_are_refused(tmp_path):
    needs("mcap")
    needs("pyarrow")
    folder = write_lerobot(tmp_path / "set", planar())
    (folder / "meta/cablejax.json").unlink()
    with pytest.raises(GapLogError, match="not written by `cablejax export lerobot`"):
        read_lerobot(folder)
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(GapLogError, match=r"version 'v2.1', expected 'v3.0'"):
        read_lerobot(folder)
    with pytest.raises(GapLogError, match="is no LeRobot data set"):
        read_lerobot(tmp_path)
    (tmp_path / "other.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(GapLogError, match="is imported with a layout"):
        read_mcap(tmp_path / "other.mcap")
    with pytest.raises(FileNotFoundError):
        read_mcap(tmp_path / "absent.mcap")


def test_fields_of_other_programs_may_hold_what_json_has_no_word_for(tmp_path):
    log = planar()
    log.meta["theirs"] = {"offset": float("nan")}
    for write, read, name in FORMATS.values():
        assert np.isnan(read(write(tmp_path / name, log)).meta["theirs"]["offset"])


@pytest.mark.parametrize("name", FORMATS)
def test_a_log_with_numpys_numbers_comes_back_and_is_joined(name, tmp_path):
    write, read, file = FORMATS[name]
    needs("mcap" if name == "mcap" else "pyarrow")
    theirs = {"gain": np.float32(1.5), "offsets": np.arange(3), "file": "caf\udce9.csv"}
    log, other = (
        gap_log_from_episodes(episodes_of(planar())[e : e + 1], Cable(), source="test", extra={"theirs": theirs})
        for e in range(2)
    )
    plain = {"gain": 1.5, "offsets": [0, 1, 2], "file": "caf?.csv"}
    assert joined([log, other], ["a", "b"]).meta["theirs"] == plain
    log.meta["theirs"] = theirs
    assert read(write(tmp_path / file, log)).meta["theirs"] == plain
    log.meta["theirs"] = object()
    with pytest.raises(GapLogError, match=r"Field 'meta' cannot be written: .* is no value that JSON has"):
        write(tmp_path / f"other {file}", log)
