"""The gap log format: what is written comes back, and what does not follow the format is named."""

import contextlib
import dataclasses
import json
import os
import pathlib

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.gaplog import (
    TARGETS,
    Episode,
    GapLogError,
    episodes_of,
    gap_log_from_episodes,
    read_gap_log,
    targets_of,
    until,
    validate,
    write_gap_log,
)
from cablejax.gaplog_join import chosen, commands_derived, joined, recordings
from cablejax.log_setup import setup_fault
from cablejax.text_file import parse_json
from cablejax.types import GapLog
from file_cases import with_other_bytes
from recording_cases import arch_take

CABLE = Cable(n_keypoints=5)
CABLE_META = {
    "length_m": 1.0,
    "diameter_m": 0.01,
    "linear_density_kg_per_m": 0.08,
    "bending_stiffness_n_m2": 0.02,
    "bending_damping_s": 0.1,
    "rest_curvature_per_m": 0.0,
}
NO_CURVATURE = {name: value for name, value in CABLE_META.items() if name != "rest_curvature_per_m"}


def episode(samples: int, motion: str = "approach", seed: int = 0) -> Episode:
    random = np.random.default_rng(seed)
    return Episode(
        motion=motion,
        time=0.1 * np.arange(samples),
        keypoints=random.normal(size=(samples, 5, 2)),
        gripper_pose=random.normal(size=(samples, 2, 3)),
        gripper_command=random.normal(size=(samples, 2, 3)),
        hold=np.arange(samples) < 3,
    )


@pytest.fixture
def log() -> GapLog:
    return gap_log_from_episodes([episode(8), episode(5, "mirror", seed=1)], CABLE, source="test")


def test_assembly_pads_short_episodes(log):
    assert log.episode_length.tolist() == [8, 5]
    assert np.isnan(log.keypoints[1, 5:]).all() and np.isfinite(log.keypoints[1, :5]).all()
    np.testing.assert_array_equal(log.gripper_command[1, 5:], 0.0)
    np.testing.assert_array_equal(log.gripper_pose[1, 5:], np.repeat(log.gripper_pose[1, 4:5], 3, axis=0))
    assert log.meta["motion"] == ["approach", "mirror"]
    assert log.meta["cable"] == CABLE_META
    assert log.meta["keypoint_arclength_m"] == [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize("seconds", [0, -1.0, np.nan, "a"])
def test_nothing_of_a_log_is_refused(log, seconds):
    with pytest.raises(ValueError, match=r"seconds is .*, expected a number"):
        until(log, seconds)


def test_the_beginning_of_a_log(log):
    short = until(log, 0.55)
    validate(short)
    assert short.episode_length.tolist() == [6, 5] and short.meta == log.meta
    for one, whole in zip(episodes_of(short), episodes_of(log), strict=True):
        assert (one.time < 0.55).all() and one.motion == whole.motion
        np.testing.assert_array_equal(one.keypoints, whole.keypoints[: len(one.time)])


def test_a_smooth_table_is_a_table():
    log = gap_log_from_episodes([episode(4)], Cable(n_keypoints=5, friction_coefficient=0.0), source="test")
    assert log.meta["table"] == {"friction_coefficient": 0.0}


def test_round_trip(tmp_path, log):
    log.keypoints[0, 2, 3] = np.nan
    path = write_gap_log(tmp_path / "new" / "run.npz", log)
    back = read_gap_log(path)
    assert back.meta == log.meta
    for field in dataclasses.fields(GapLog):
        if field.name != "meta":
            written, read = getattr(log, field.name), getattr(back, field.name)
            assert read.dtype == written.dtype
            np.testing.assert_array_equal(read, written)


def test_a_log_without_hold_is_complete(tmp_path, log):
    path = write_gap_log(tmp_path / "run.npz", dataclasses.replace(log, hold=None))
    assert read_gap_log(path).hold is None


def test_nothing_is_overwritten_unasked_and_nothing_half_written(tmp_path, log):
    path = write_gap_log(tmp_path / "run.npz", log)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"run\.npz exists"):
        write_gap_log(path, log)
    broken = dataclasses.replace(log, time=log.time[:, ::-1].copy())
    with pytest.raises(GapLogError, match="'time'"):
        write_gap_log(path, broken, overwrite=True)
    assert path.read_bytes() == before
    other = gap_log_from_episodes([episode(4)], CABLE, source="other")
    write_gap_log(path, other, overwrite=True)
    assert read_gap_log(path).meta["source"] == "other"
    assert [file.name for file in tmp_path.iterdir()] == ["run.npz"]


@pytest.mark.parametrize("name", ["time", "keypoints", "gripper_pose", "gripper_command", "episode_length", "meta"])
def test_a_missing_field_is_named(tmp_path, log, name):
    fields = {
        "time": log.time,
        "keypoints": log.keypoints,
        "gripper_pose": log.gripper_pose,
        "gripper_command": log.gripper_command,
        "episode_length": log.episode_length,
        "meta": json.dumps(log.meta),
    }
    del fields[name]
    np.savez(tmp_path / "run.npz", **fields)
    with pytest.raises(GapLogError, match=f"lacks {name}"):
        read_gap_log(tmp_path / "run.npz")


@pytest.mark.parametrize(
    "name", ["schema", "cable", "table", "gravity_m_per_s2", "keypoint_arclength_m", "grasp", "motion", "source"]
)
def test_a_missing_meta_field_is_named(log, name):
    meta = {key: value for key, value in log.meta.items() if key != name}
    with pytest.raises(GapLogError, match=f"'meta.{name}' is missing"):
        validate(dataclasses.replace(log, meta=meta))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": "cablejax-gap-log/2"}, r"'meta' has schema .*/2', expected .*/1' or older: a newer version"),
        ({"cable": {"length_m": 1.0}}, r"meta\.cable.*lacks diameter_m"),
        (
            {"cable": CABLE_META | {"bending_stiffness_n_m2": 0}},
            "bending_stiffness_n_m2 is 0, expected a number",
        ),
        ({"cable": CABLE_META | {"length_m": 10**400}}, "length_m is an integer of 1329 bits"),
        ({"cable": CABLE_META | {"length_m": 0.5}}, r"goes from 0 to 1 m, expected 0 to the cable's length of 0.5 m"),
        ({"table": {}}, r"meta\.table.*lacks friction_coefficient"),
        ({"table": {"friction_coefficient": -0.1}}, "friction_coefficient is -0.1, expected"),
        ({"cable": CABLE_META | {"linear_density_kg_per_m": 100}}, "which no material exceeds"),
        ({"gravity_m_per_s2": [0.0, 0.0, 0.0]}, "is 0.0, expected a number from 1 to 30"),
        ({"gravity_m_per_s2": [0.0, 0.0, -1e20]}, r"is 1e\+20, expected a number from 1 to 30"),
        ({"gravity_m_per_s2": [0.0, 0.0, 9.81]}, "off the table"),
        ({"gravity_m_per_s2": [0.0, -9.81]}, r"meta\.gravity_m_per_s2"),
        ({"keypoint_arclength_m": [0.0, 0.5, 1.0]}, r"meta\.keypoint_arclength_m"),
        ({"keypoint_arclength_m": [0.0, 0.5, 0.4, 0.8, 1.0]}, r"meta\.keypoint_arclength_m"),
        ({"keypoint_arclength_m": [-0.04, -0.01, 0.5, 0.8, 1.0]}, r"meta\.keypoint_arclength_m.*within 0 to"),
        ({"table": {"friction_coefficient": 0.1, "length_m": 2.0}}, r"'meta\.table' has length_m, which belongs"),
        ({"cable": CABLE_META | {"rest_curvature_per_metre": 1.0}}, None),
        ({"cable": NO_CURVATURE | {"rest_curvature": 1.0}}, r"'meta\.cable' has rest_curvature without its unit"),
        ({"cable": NO_CURVATURE | {"rest_curvture_per_m": 1.0}}, "Did you mean rest_curvature_per_m"),
        ({"cable": NO_CURVATURE | {"colour": "red", "curvature_seen": True}}, None),
        ({"grasp": ["clamped"]}, r"meta\.grasp"),
        ({"motion": "approach"}, r"meta\.motion"),
        ({"source": None}, r"meta\.source"),
    ],
)
def test_wrong_meta_is_named(log, changes, message):
    with contextlib.nullcontext() if message is None else pytest.raises(GapLogError, match=message):
        validate(dataclasses.replace(log, meta=log.meta | changes))


def test_names_and_numbers_that_json_lacks_are_written_so_that_they_can_be_read(tmp_path, log):
    log.meta["recorded by"] = {"temperature": np.float32(21.5), "file": "caf\udce9.csv", "offsets": np.arange(3)}
    read = read_gap_log(write_gap_log(tmp_path / "run.npz", log))
    assert read.meta["recorded by"] == {"temperature": 21.5, "file": "caf?.csv", "offsets": [0, 1, 2]}
    log.meta["recorded by"] = object()
    with pytest.raises(GapLogError, match=r"Field 'meta' cannot be written: .* is no value that JSON has"):
        write_gap_log(tmp_path / "other.npz", log)


@pytest.mark.parametrize("name", ["time", "other"])
def test_only_simulated_keypoints_are_stored_with_a_log(tmp_path, log, name):
    with pytest.raises(GapLogError, match=rf"simulated keypoints '{name}' .*expected nominal or explained"):
        write_gap_log(tmp_path / "run.npz", log, simulated={name: log.keypoints})
    with pytest.raises(GapLogError, match=r"'nominal' have shape \(2, 7, 5, 2\), expected"):
        write_gap_log(tmp_path / "run.npz", log, simulated={"nominal": log.keypoints[:, :-1]})
    assert not list(tmp_path.iterdir())


def test_masks_and_episodes_without_samples_are_refused():
    one = episode(8)
    hidden = np.ma.masked_array(one.keypoints, np.zeros(one.keypoints.shape, bool))
    shown = log_of_episode(dataclasses.replace(one, keypoints=hidden)).keypoints
    np.testing.assert_array_equal(shown[0], one.keypoints.astype(np.float32))
    hidden[3, 2] = np.ma.masked
    with pytest.raises(GapLogError, match=r"keypoints is a masked array.*write NaN"):
        log_of_episode(dataclasses.replace(one, keypoints=hidden))
    with pytest.raises(GapLogError, match=r"keypoints is an array of complex128, expected real numbers"):
        log_of_episode(dataclasses.replace(one, keypoints=one.keypoints.astype(complex)))
    with pytest.raises(GapLogError, match="no sample, expected at least one"):
        log_of_episode(episode(0))


def test_a_log_without_grippers_is_refused(log):
    with pytest.raises(GapLogError, match=r"'gripper_pose' has shape \(2, 8, 0, 3\), expected \(2, 8, 1, 3\)"):
        validate(dataclasses.replace(log, gripper_pose=log.gripper_pose[:, :, :0]))


def log_of_episode(one: Episode) -> GapLog:
    return gap_log_from_episodes([one], CABLE, source="test")


def test_wrong_arrays_are_named(log):
    def refuses(message, **changes):
        with pytest.raises(GapLogError, match=message):
            validate(dataclasses.replace(log, **changes))

    refuses("'keypoints' is float64", keypoints=log.keypoints.astype(float))
    refuses("'keypoints' has shape", keypoints=log.keypoints[..., :1])
    refuses("'gripper_pose' has shape", gripper_pose=log.gripper_pose[..., :2])
    refuses("'gripper_command' has shape", gripper_command=log.gripper_command[:, :-1])
    refuses("'episode_length' is 9", episode_length=np.array([9, 5], np.int32))
    refuses("'gripper_pose' is not finite", gripper_pose=np.full_like(log.gripper_pose, np.nan))
    refuses("at least one episode and two keypoints", keypoints=log.keypoints[:, :, :1])
    refuses("'keypoints' is infinite", keypoints=np.full_like(log.keypoints, np.inf))
    with pytest.raises(GapLogError, match="at least one episode"):
        gap_log_from_episodes([], CABLE, source="test")
    with pytest.raises(GapLogError, match="gripper_pose has shape"):
        gap_log_from_episodes([dataclasses.replace(episode(4), gripper_pose=np.zeros((3, 2, 3)))], CABLE, source="test")


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (
            np.append(0.1 * np.arange(7), 1e9),
            r"first to the last sample of episode 0 is .*, expected a number from 0 to",
        ),
        (0.1 * np.arange(8) + 1e3 * (np.arange(8) > 4), "pause of 1000 s after sample 4 of episode 0, where 0.1 s"),
        (
            1e-9 * np.arange(8),
            r"usual time between samples of episode 0 is 1e-09, expected a number from 0\.0001.*unit`\)\?$",
        ),
        (2.0 * np.arange(8), r"usual time between samples of episode 0 is 2\.0.* record at least once a second"),
        (1.7e9 + 0.1 * np.arange(8), "first time of episode 0 is 1700000000.0, .* subtract the first of each episode"),
    ],
    ids=["a jump of 1e9 s", "a jump of 1000 s", "steps of 1e-9 s", "steps of 2 s", "since 1970"],
)
def test_a_clock_that_no_recording_has_is_refused(tmp_path, log, time, message):
    times = log.time.copy()
    times[0] = time
    broken = dataclasses.replace(log, time=times)
    with pytest.raises(GapLogError, match=message):
        validate(broken)
    arrays = {field.name: getattr(broken, field.name) for field in dataclasses.fields(broken) if field.name != "meta"}
    np.savez(tmp_path / "run.npz", **arrays, meta=np.array(json.dumps(broken.meta)))
    with pytest.raises(GapLogError, match=message):
        read_gap_log(tmp_path / "run.npz")


def test_nothing_is_unpickled(tmp_path, log):
    np.savez(tmp_path / "run.npz", time=np.array([{}], dtype=object), meta="{}")
    with pytest.raises(GapLogError, match="could not be read"):
        read_gap_log(tmp_path / "run.npz")
    with pytest.raises(GapLogError, match="holds Python objects"):
        read_gap_log(tmp_path / "run.npz")


def test_what_a_file_holds_beside_the_format_is_left_alone(tmp_path, log):
    path = write_gap_log(tmp_path / "run.npz", log)
    with np.load(path) as archive:
        fields = dict(archive)
    np.savez(tmp_path / "more.npz", **fields, notes=np.array([{}], dtype=object))
    assert read_gap_log(tmp_path / "more.npz").meta == log.meta


def test_a_file_that_is_no_archive_or_damaged_is_refused(tmp_path, log):
    (tmp_path / "text.npz").write_text("not an archive")
    np.save(tmp_path / "array.npy", np.zeros(3))
    for name in ("text.npz", "array.npy"):
        with pytest.raises(GapLogError, match=r"no \.npz archive\. Expected a gap log .* as `cablejax import` makes"):
            read_gap_log(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="There is no file"):
        read_gap_log(tmp_path / "absent.npz")
    path = write_gap_log(tmp_path / "run.npz", log)
    (tmp_path / "half.npz").write_bytes(path.read_bytes()[:1000])
    with pytest.raises(GapLogError, match=r"half\.npz is cut off: make it again\. Expected a gap log"):
        read_gap_log(tmp_path / "half.npz")
    for broken in with_other_bytes(path.read_bytes(), 60):
        path.write_bytes(broken)
        with contextlib.suppress(GapLogError):
            read_gap_log(path)


def test_a_command_that_is_never_held_may_be_anything(log):
    command = log.gripper_command.copy()
    command[0, log.episode_length[0] - 1] = np.nan
    validate(dataclasses.replace(log, gripper_command=command))


def test_logs_of_another_program():
    data = os.environ.get("CABLEJAX_DATA")
    files = sorted((pathlib.Path(data).parent / "gap-dev").glob("*.npz")) if data else []
    if not files:
        pytest.skip("CABLEJAX_DATA does not point to a folder with gap-dev next to it")
    for path in files:
        log = read_gap_log(path)
        assert log.keypoints.dtype == np.float32 and log.gripper_pose.dtype == np.float32
        assert log.hold is not None and log.hold.any()
        held = log.keypoints[0, : log.episode_length[0]][:, [0, -1]]
        apart = held - log.gripper_pose[0, : log.episode_length[0], :, :2]
        assert np.nanmedian(np.linalg.norm(apart, axis=-1)) < 0.05


def test_keypoints_may_be_anywhere_and_further_fields_travel(tmp_path):
    arclength = [0.0, 0.1, 0.5, 0.7, 1.0]
    cable = dataclasses.replace(CABLE, marks=tuple(arclength))
    log = gap_log_from_episodes([episode(4)], cable, source="test", extra={"split": ["train"]})
    back = read_gap_log(write_gap_log(tmp_path / "run.npz", log))
    assert back.meta["keypoint_arclength_m"] == arclength and back.meta["split"] == ["train"]
    with pytest.raises(GapLogError, match="keypoint_arclength_m"):
        gap_log_from_episodes([episode(4)], Cable(n_keypoints=2), source="test")
    with pytest.raises(GapLogError, match="extra fields source are fields of the format"):
        gap_log_from_episodes([episode(4)], CABLE, source="test", extra={"source": "other"})


def test_half_a_character_is_no_text():
    with pytest.raises(ValueError, match=r"holds half of a character \('\\udc80'\)"):
        parse_json('{"source": "run \\udc80"}')
    assert parse_json('"\\ud83d\\ude00"') == "\U0001f600"


class TestJoined:
    """Several recordings of one set-up as one log."""

    def _halves(self) -> tuple[list[GapLog], list[str]]:
        one = gap_log_from_episodes([episode(8)], CABLE, source="test")
        two = gap_log_from_episodes([episode(5, "mirror", seed=1)], CABLE, source="test")
        return [one, two], ["a.npz", "b.npz"]

    def test_the_parts_of_a_log_make_it_again(self, log):
        whole = joined(*self._halves())
        for field in dataclasses.fields(GapLog):
            if field.name != "meta":
                np.testing.assert_array_equal(getattr(whole, field.name), getattr(log, field.name), err_msg=field.name)
        parts = [{"name": "a.npz", "episodes": 1}, {"name": "b.npz", "episodes": 1}]
        assert whole.meta == {**log.meta, "recordings": parts}

    def test_joining_twice_keeps_the_names(self, log):
        third = gap_log_from_episodes([episode(6)], CABLE, source="test")
        again = joined([joined(*self._halves()), third], ["ab.npz", "c.npz"])
        assert [part["name"] for part in recordings(again)] == ["a.npz", "b.npz", "c.npz"]

    def test_labels_of_episodes_stay_with_them_and_recordings_apart(self):
        logs, names = self._halves()
        logs[0].meta.update(recording=["1"], take=["1/1"])
        logs[1].meta.update(recording=["1"], split=["eval"])
        meta = joined(logs, names).meta
        assert meta["recording"] == ["a.npz: 1", "b.npz: 1"] and meta["take"] == ["a.npz: 1/1", "b.npz: 0"]
        assert meta["split"] == ["", "eval"] and "file" not in meta

    def test_what_one_recording_guessed_is_a_guess(self):
        logs, names = self._halves()
        logs[1].meta["guessed"] = ["linear_density_kg_per_m"]
        assert joined(logs, names).meta["guessed"] == ["linear_density_kg_per_m"]
        assert "guessed" not in joined(*self._halves()).meta

    def test_a_recording_without_holds(self):
        logs, names = self._halves()
        logs[1] = dataclasses.replace(logs[1], hold=None)
        whole = joined(logs, names)
        assert whole.hold is not None
        assert whole.hold[0].any() and not whole.hold[1].any()

    @pytest.mark.parametrize(
        ("cable", "field"),
        [
            (Cable(n_keypoints=5, bending_stiffness=0.01), "bending_stiffness_n_m2"),
            (Cable(n_keypoints=5, friction_coefficient=0.2), "table"),
        ],
    )
    def test_another_set_up_is_refused_by_the_field(self, cable, field):
        logs, names = self._halves()
        logs[1] = gap_log_from_episodes([episode(5, seed=1)], cable, source="test")
        with pytest.raises(
            GapLogError, match=rf"b.npz is not of the set-up of a.npz: .*{field}.* Diagnose them separately"
        ):
            joined(logs, names)

    def test_arc_lengths_that_were_measured_apart_are_averaged(self):
        logs, names = self._halves()
        for log, stretch in zip(logs, (1.0, 1.002), strict=True):
            marks = (stretch * np.asarray(log.meta["keypoint_arclength_m"])).tolist()
            log.meta.update(keypoint_arclength_m=marks, arclength_measured=True)
            log.meta["cable"] = {**log.meta["cable"], "length_m": marks[-1]}
        one, two = (log.meta["keypoint_arclength_m"] for log in logs)
        whole = joined(logs, names).meta
        np.testing.assert_allclose(whole["keypoint_arclength_m"], np.mean([one, two], axis=0))
        assert whole["cable"]["length_m"] == whole["keypoint_arclength_m"][-1] and whole["arclength_measured"]
        farther = (1.02 * np.asarray(two)).tolist()
        for change in ({"arclength_measured": False}, {"keypoint_arclength_m": farther}):
            other = dataclasses.replace(logs[1], meta={**logs[1].meta, **change})
            with pytest.raises(
                GapLogError, match=r"b.npz is not of the set-up of a.npz: 'meta.*(length_m|arclength_m)'"
            ):
                joined([logs[0], other], names)

    def test_commands_that_an_importer_made_are_known_episode_by_episode(self):
        logs, names = self._halves()
        logs[0].meta.update(commands_from_poses=True)
        whole = joined(logs, names)
        assert whole.meta["commands_from_poses"] == [True, False] and commands_derived(whole).tolist() == [True, False]
        assert chosen(whole, [1]).meta["commands_from_poses"] == [False]
        logs[1].meta.update(commands_from_poses=True)
        assert joined(logs, names).meta["commands_from_poses"] is True
        for wrong in ("yes", [True, False]):
            logs[0].meta.update(commands_from_poses=wrong)
            with pytest.raises(
                GapLogError, match=r"commands_from_poses' is .*, expected true or false, or a list of 1"
            ):
                joined(logs, names)

    def test_numbers_within_rounding_are_of_one_set_up(self):
        logs, names = self._halves()
        marks = [0.1 * k * 2.5 for k in range(5)]
        logs[1].meta.update(keypoint_arclength_m=[float(np.float32(mark)) for mark in marks])
        logs[1].meta["cable"] = {**logs[1].meta["cable"], "length_m": 1.0 + 1e-10}
        assert joined(logs, names).meta["cable"]["length_m"] == 1.0
        logs[1].meta.update(keypoint_arclength_m=[0.0, 0.25, 0.50001, 0.75, 1.0])
        with pytest.raises(GapLogError, match="keypoint_arclength_m"):
            joined(logs, names)

    def test_the_same_recording_counts_once(self, log):
        with pytest.raises(GapLogError, match=r"a\.npz and copy\.npz share an episode with identical samples"):
            joined([log, log], ["a.npz", "copy.npz"])
        # imported again: of another precision, and with corrected poses
        again = dataclasses.replace(log, keypoints=log.keypoints.astype(float), gripper_pose=log.gripper_pose + 0.01)
        # in another unit, and on a clock that began earlier
        later = dataclasses.replace(log, keypoints=log.keypoints.astype(float) * (1 + 1e-7), time=log.time + 1000.0)
        for copy in (again, later):
            with pytest.raises(GapLogError, match="share an episode with identical samples"):
                joined([log, copy], ["a.npz", "again.npz"])
        logs, names = self._halves()
        with pytest.raises(GapLogError, match=r"both and b\.npz share an episode with identical samples"):
            joined([joined(logs, names), logs[1]], ["both", "b.npz"])
        with pytest.raises(GapLogError, match="There are 1 names, expected one for each of the 2 gap logs"):
            joined(logs, ["a.npz"])

    def test_commands_without_a_recording_are_no_recording(self):
        logs, names = self._halves()
        unseen = dataclasses.replace(logs[1], keypoints=np.full_like(logs[1].keypoints, np.nan))
        with pytest.raises(GapLogError, match=r"No keypoint is observed in b\.npz: .* give the recording"):
            joined([logs[0], unseen], names)

    def test_what_was_joined_is_taken_apart(self):
        logs, names = self._halves()
        whole = joined(logs, names)
        whole.meta["split"] = ["train", "eval"]
        second = chosen(whole, [1])
        for field in dataclasses.fields(GapLog):
            if field.name != "meta":
                np.testing.assert_array_equal(getattr(second, field.name), getattr(logs[1], field.name))
        parts = [{"name": "b.npz", "episodes": 1}]
        assert second.meta == {**logs[1].meta, "split": ["eval"], "recordings": parts}
        assert chosen(whole, range(2)).meta == whole.meta

    @pytest.mark.parametrize("episodes", [[], [2], [-1], [1, 0], [0, 0], [0.7], [True]])
    def test_episodes_that_are_not_there(self, log, episodes):
        with pytest.raises(GapLogError, match="expected increasing numbers below 2"):
            chosen(log, episodes)

    def test_nothing_is_no_log(self):
        with pytest.raises(GapLogError, match="Nothing to join"):
            joined([], [])

    @pytest.mark.parametrize(
        "parts", [3, [{"name": "a"}], [{"name": "a", "episodes": 1}], [{"name": 1, "episodes": 2}]]
    )
    def test_recordings_that_do_not_add_up(self, log, parts):
        with pytest.raises(GapLogError, match=r"meta\.recordings"):
            recordings(dataclasses.replace(log, meta={**log.meta, "recordings": parts}))


def test_names_of_guesses_are_not_taken_for_labels_of_episodes():
    one = dataclasses.replace(episode(8), gripper_pose=np.zeros((8, 2, 3)), keypoints=straight(8))
    whole = gap_log_from_episodes([one] * 3, CABLE, source="test")
    guessed = ["diameter_m", "linear_density_kg_per_m", "bending_stiffness_n_m2"]
    some = chosen(dataclasses.replace(whole, meta={**whole.meta, "guessed": guessed}), [0, 2])
    assert some.meta["guessed"] == guessed and len(some.meta["motion"]) == 2


def straight(samples: int) -> np.ndarray:
    return np.broadcast_to(np.stack([np.linspace(0, 1, 5), np.zeros(5)], axis=1), (samples, 5, 2)).copy()


def test_targets_of_joined_recordings_stay_with_their_episodes():
    logs = [gap_log_from_episodes([episode(8, seed=seed)], CABLE, source="test") for seed in range(2)]
    target = np.arange(10.0).reshape(5, 2)
    logs[1].meta[TARGETS] = [target.tolist()]
    first, second = targets_of(joined(logs, ["a.npz", "b.npz"]))
    assert first is None
    np.testing.assert_array_equal(second, target)


def test_the_beginning_of_a_log_whose_clock_ran_before(log):
    later = dataclasses.replace(log, time=log.time + 100.0)
    np.testing.assert_array_equal(until(later, 0.35).episode_length, until(log, 0.35).episode_length)


def test_a_gripper_far_from_the_next_keypoint_shows_no_direction():
    """A chord of 0.4 m of a bent cable may be at any angle to the clamp; one of 0.1 m may not."""
    for first, fault in ((0.4, False), (0.1, True)):
        marks = np.array([0.0, first, 0.45, 0.5, 0.6, 1.0])
        one = arch_take(marks, np.linspace(1.4, 1.6, 30))
        pose = one.gripper_pose.copy()
        pose[:, 0, 2] += 0.0 if first > 0.3 else 1.3
        episode = Episode("bend", one.time, one.keypoints, pose, np.zeros((30, 2, 3)), np.zeros(30, bool))
        bent = gap_log_from_episodes([episode], Cable(n_keypoints=6, marks=tuple(marks)), source="test")
        assert (setup_fault(bent) is not None) == fault


def test_lengths_of_episodes_that_do_not_fit_their_type_are_refused(tmp_path, log):
    path = write_gap_log(tmp_path / "run.npz", log)
    with np.load(path) as file:
        arrays = dict(file)
    arrays["episode_length"] = arrays["episode_length"].astype(np.int64) + 2**32
    np.savez(tmp_path / "wide.npz", **arrays)
    with pytest.raises(GapLogError, match=r"field 'episode_length' has 42949\d+, too large for int32"):
        read_gap_log(tmp_path / "wide.npz")


@pytest.mark.parametrize("interval", [1e-4, 1.004])
def test_the_clock_may_be_as_fast_and_as_slow_as_trackers_are(log, interval):
    validate(
        dataclasses.replace(log, time=np.broadcast_to(interval * np.arange(log.time.shape[1]), log.time.shape).copy())
    )


def test_another_programs_guesses_are_left_alone(log):
    moved = log.keypoints + np.float32(1e-3)
    other = dataclasses.replace(log, keypoints=moved, meta={**log.meta, "guessed": "diameter_m"})
    assert "guessed" not in joined([log, other], ["one", "other"]).meta
