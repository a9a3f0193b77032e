"""Recordings of the DEFORM data set, made up in its format, and the real ones where they are."""

import os
import pickle

import numpy as np
import pytest

from cablejax.gaplog import read_gap_log, write_gap_log
from cablejax.recordings.deform import DeformRecordings, import_deform, read_deform
from recording_cases import DATA, DT, needs_deform, swinging


def blocks() -> dict[tuple[str, int], np.ndarray]:
    """Two recordings, of the blocks 3 and 4, and 5; and another, of block 9."""
    first, second, third = swinging(400), swinging(200, seed=1, phase=5.0), swinging(200, seed=2, phase=9.0)
    second[..., 0] += 0.2
    return {("train", 3): first[:200], ("eval", 4): first[200:], ("train", 5): second, ("train", 9): third}


@pytest.fixture
def folder(tmp_path):
    """Upstream's folder of one cable: the coordinate comes before the marker, as an array or as a list of arrays."""
    for (split, number), points in blocks().items():
        path = tmp_path / "DLO9" / split / f"{number}.pkl"
        path.parent.mkdir(parents=True, exist_ok=True)
        value = points.transpose(0, 2, 1)
        path.write_bytes(pickle.dumps(list(value) if number == 5 else value))
    return tmp_path / "DLO9"


@pytest.fixture
def archive(tmp_path):
    path = tmp_path / "DLO9.npz"
    np.savez(path, **fields())
    return path


def fields() -> dict[str, np.ndarray]:
    return {
        "keypoints": np.array(list(blocks().values()), np.float32),
        "dt": np.float32(DT),
        "split": np.array([split for split, _ in blocks()]),
        "source_id": np.array([number for _, number in blocks()]),
        "recording_guess": np.array([0, 0, 1, 2]),
    }


def test_a_folder_of_pickles_is_read_in_the_order_of_its_numbers(folder):
    recordings = read_deform(folder)
    np.testing.assert_array_equal(recordings.keypoints, list(blocks().values()))
    assert recordings.source_id.tolist() == [3, 4, 5, 9]
    assert recordings.split.tolist() == ["train", "eval", "train", "train"]
    assert recordings.recording.tolist() == [0, 0, 1, 2]
    assert recordings.dt == DT and recordings.name == "DLO9"


def test_an_archive_is_read_the_same(folder, archive):
    a, b = read_deform(folder), read_deform(archive)
    np.testing.assert_allclose(a.keypoints, b.keypoints, atol=1e-6)
    assert b.keypoints.dtype == float and b.dt == DT
    for name in ("split", "source_id", "recording"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_one_pickle_is_a_recording_of_its_own(folder):
    recordings = read_deform(folder / "eval" / "4.pkl")
    assert recordings.keypoints.shape == (1, 200, 9, 3) and recordings.split.tolist() == ["eval"]


def test_blocks_without_a_position_are_left_out_and_hidden_files_are_no_blocks(folder):
    (folder / "train" / "._1.pkl").write_bytes(b"of another system")
    every, _ = import_deform(folder)
    lost = next(iter(sorted(folder.glob("*/[0-9]*.pkl"))))
    lost.write_bytes(pickle.dumps(np.full_like(pickle.loads(lost.read_bytes()), np.nan)))
    log, repairs = import_deform(folder)
    assert log.meta["file"] == [file for file in every.meta["file"] if file != int(lost.stem)]
    assert repairs[0] == f"Block {lost.stem} has no observed position: left out."


def test_a_short_block_ends_with_nan_and_its_episode_ends_there(folder):
    path = folder / "train" / "9.pkl"
    path.write_bytes(pickle.dumps(swinging(120).transpose(0, 2, 1)))
    recordings = read_deform(folder)
    assert np.isnan(recordings.keypoints[3, 120:]).all() and np.isfinite(recordings.keypoints[3, :120]).all()
    log, repairs = import_deform(folder)
    assert log.episode_length.tolist() == [200, 200, 200, 120] and repairs == []


def test_the_log_carries_split_and_recordings(tmp_path, folder):
    log, repairs = import_deform(folder)
    back = read_gap_log(write_gap_log(tmp_path / "log.npz", log))
    assert repairs == []
    assert back.meta["split"] == ["train", "eval", "train", "train"]
    assert back.meta["recording"] == [0, 0, 1, 2] and back.meta["file"] == [3, 4, 5, 9]
    assert "guesses" in back.meta["source"] and back.meta["table"] is None
    assert back.meta["cable"]["length_m"] == pytest.approx(0.69, abs=2e-3)
    assert back.gripper_pose.shape == (4, 200, 2, 7) and back.gripper_command.shape == (4, 200, 2, 6)


def test_a_pickle_that_executes_something_is_refused_and_not_run(folder):
    class Gadget:
        def __reduce__(self):
            return os.system, (f"touch {folder / 'ran'}",)

    (folder / "train" / "5.pkl").write_bytes(pickle.dumps(Gadget()))
    with pytest.raises(ValueError, match=r"5\.pkl was not read: it refers to posix\.system"):
        read_deform(folder)
    assert not (folder / "ran").exists()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((200, 3)), r"positions of shape \(200, 3\), expected \(T, 3, N\)"),
        (np.zeros((200, 2, 9)), r"positions of shape \(200, 2, 9\)"),
        ({"a": np.zeros(3)}, "holds dict"),
        ([np.zeros((3, 9)), np.zeros((3, 8))], "holds list"),
        (swinging()[:, :7].transpose(0, 2, 1), r"has 7 markers where the others have 9: a gripper's pair is missing"),
    ],
    ids=["flat", "planar", "dictionary", "ragged", "fewer markers"],
)
def test_wrong_blocks_are_refused(folder, value, message):
    (folder / "train" / "5.pkl").write_bytes(pickle.dumps(value))
    with pytest.raises(ValueError, match=message):
        read_deform(folder)


def test_wrong_folders_are_refused(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"has no \.pkl files"):
        read_deform(tmp_path / "empty")
    with pytest.raises(ValueError, match=r"is neither an \.npz file"):
        read_deform(tmp_path / "absent.mat")
    (folder / "eval" / "5.pkl").write_bytes((folder / "train" / "5.pkl").read_bytes())
    with pytest.raises(ValueError, match=r"has 5\.pkl twice"):
        read_deform(folder)
    (folder / "eval" / "5.pkl").rename(folder / "eval" / "notes.pkl")
    with pytest.raises(ValueError, match=r"notes\.pkl is not named by a number"):
        read_deform(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keypoints": None}, "lacks keypoints"),
        ({"keypoints": np.zeros((4, 200, 9, 2))}, r"keypoints has shape \(4, 200, 9, 2\)"),
        ({"keypoints": np.zeros((4, 200, 9, 3), int)}, "expected floating point numbers"),
        ({"split": np.array(["train"])}, r"split has shape \(1,\), expected \(4,\)"),
        ({"split": np.array(["train", "Eval", "train", "train"])}, "split has 'Eval', expected train, eval, which is"),
        ({"dt": np.float32(np.nan)}, "dt is nan"),
    ],
    ids=["missing", "planar", "integers", "split", "splits", "dt"],
)
def test_wrong_archives_are_refused(tmp_path, change, message):
    values = {name: value for name, value in (fields() | change).items() if value is not None}
    np.savez(tmp_path / "DLO9.npz", **values)
    with pytest.raises(ValueError, match=message):
        read_deform(tmp_path / "DLO9.npz")


def test_a_missing_gripper_pair_is_refused_and_a_missing_moment_cut(tmp_path):
    values = fields()
    values["keypoints"][:, :, :2] = np.nan
    np.savez(tmp_path / "DLO9.npz", **values)
    with pytest.raises(ValueError, match="Keypoints 0 and 1 are never observed together"):
        import_deform(tmp_path / "DLO9.npz")
    values = fields()
    values["keypoints"][1, :, 7:] = np.nan  # in one block only: that block is left out
    values["keypoints"][2, 80:110] = np.nan
    np.savez(tmp_path / "DLO9.npz", **values)
    log, repairs = import_deform(tmp_path / "DLO9.npz")
    assert log.meta["take"] == ["3", "5/1", "5/2", "9"] and log.episode_length.tolist() == [200, 80, 90, 200]
    assert any(line.startswith("Take 4: in 200 samples one of the gripper poses is missing") for line in repairs)
    assert all(line in log.meta["source"] for line in repairs)


@needs_deform
@pytest.mark.parametrize(
    ("name", "markers", "length"),
    [
        pytest.param("DLO1", 13, 1.04, marks=pytest.mark.slow),
        pytest.param("DLO2", 12, 0.92, marks=pytest.mark.slow),
        ("DLO3", 12, 0.98),
    ],
)
def test_real_recordings_are_read(name, markers, length):
    recordings = read_deform(DATA / "deform" / f"{name}.npz")
    assert isinstance(recordings, DeformRecordings)
    assert recordings.keypoints.shape == (70, 500, markers, 3)
    assert sorted(set(recordings.split)) == ["eval", "train"] and (recordings.split == "eval").sum() == 14
    log, repairs = import_deform(DATA / "deform" / f"{name}.npz")
    assert log.meta["cable"]["length_m"] == pytest.approx(length, abs=0.01)
    assert np.isfinite(log.gripper_pose).all()
    # The recordings themselves have the faults that the importer looks for, and few of them.
    misread = [line.split(" leaves its path")[0] for line in repairs if "leaves its path" in line]
    found = {
        "DLO1": ["Take 58: keypoint 6", "Take 66: keypoint 7", "Take 98: keypoint 0"],
        "DLO2": ["Take 105: keypoint 1"],
        "DLO3": ["Take 12: keypoint 4", "Take 26: keypoint 4"],
    }
    assert misread == found[name]
    assert len(repairs) - len(misread) < 25
    exchanged = [line for line in repairs if "exchanged" in line]
    if name == "DLO1":
        assert [line.split(", and")[0] for line in exchanged] == [
            "Take 89: keypoints 11, 12 had exchanged their names in 71 of 500 samples, from sample 429",
            "Take 90: keypoints 11, 12 had exchanged their names in 500 of 500 samples, from sample 0",
        ]
    else:
        assert exchanged == []


@needs_deform
def test_real_recordings_as_pickles_have_the_same_groups(tmp_path):
    """The blocks that follow each other are found from their numbers and ends alone."""
    archive = read_deform(DATA / "deform" / "DLO2.npz")
    for points, split, number in zip(archive.keypoints, archive.split, archive.source_id, strict=True):
        path = tmp_path / "DLO2" / str(split) / f"{number}.pkl"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(points.transpose(0, 2, 1)))
    recordings = read_deform(tmp_path / "DLO2")
    np.testing.assert_array_equal(recordings.keypoints, archive.keypoints)
    np.testing.assert_array_equal(np.diff(recordings.recording) != 0, np.diff(archive.recording) != 0)
