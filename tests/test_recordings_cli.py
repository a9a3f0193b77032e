"""`cablejax import` as a person or a script meets it."""

import json
import pickle

import pytest

from cablejax.cli import main
from cablejax.gaplog import read_gap_log
from recording_cases import swinging


@pytest.fixture
def folder(tmp_path):
    for split, number in (("train", 1), ("eval", 5)):
        path = tmp_path / "DLO9" / split / f"{number}.pkl"
        path.parent.mkdir(parents=True)
        path.write_bytes(pickle.dumps(swinging(seed=number, phase=number).transpose(0, 2, 1)))
    return tmp_path / "DLO9"


@pytest.mark.parametrize("kind", ["deform", "csv", "mcap"])
def test_help_explains_every_kind(kind, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["import", kind, "--help"])
    assert stop.value.code == 0 and "--out" in capsys.readouterr().out


def test_pickles_become_a_log(folder, tmp_path, capsys):
    out = tmp_path / "log.npz"
    assert main(["import", "deform", str(folder), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "2 episodes, 400 samples (3.98 s at 100 Hz) of 9 keypoints in space" in shown
    assert "Nothing had to be repaired." in shown
    assert read_gap_log(out).meta["split"] == ["train", "eval"]
    assert main(["import", "deform", str(folder), "--out", str(out)]) == 2
    assert "add --overwrite" in capsys.readouterr().err
    assert main(["import", "deform", str(folder), "--out", str(out), "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["logs"][0]["episodes"] == 2


def test_one_is_not_many(folder, tmp_path, capsys):
    assert main(["import", "deform", str(folder / "train" / "1.pkl"), "--out", str(tmp_path / "log.npz")]) == 0
    assert ": 1 episode, 200 samples (1.99 s at 100 Hz) of 9 keypoints in space" in capsys.readouterr().out


def test_repairs_are_reported(folder, tmp_path, capsys):
    points = swinging(seed=1, phase=1)
    points[60:130] = points[60:130][:, [0, 1, 2, 4, 3, 5, 6, 7, 8]]
    (folder / "train" / "1.pkl").write_bytes(pickle.dumps(1000 * points.transpose(0, 2, 1)))
    (folder / "eval" / "5.pkl").write_bytes(pickle.dumps(1000 * swinging(seed=5, phase=5).transpose(0, 2, 1)))
    out = tmp_path / "log.npz"
    assert main(["import", "deform", str(folder), "--out", str(out), "--json"]) == 0
    repairs = json.loads(capsys.readouterr().out)["logs"][0]["repairs"]
    assert len(repairs) == 2 and "mm" in repairs[0] and "keypoints 3, 4 had exchanged" in repairs[1]
    assert all(line in read_gap_log(out).meta["source"] for line in repairs)


def test_a_dangerous_pickle_is_refused_without_a_traceback(folder, tmp_path, capsys):
    (folder / "train" / "1.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    assert main(["import", "deform", str(folder), "--out", str(tmp_path / "log.npz")]) == 2
    shown = capsys.readouterr()
    assert "refers to os.system" in shown.err and "Traceback" not in shown.err and shown.out == ""
    assert not (tmp_path / "log.npz").exists()


def test_a_wrong_frame_is_refused(folder, tmp_path, capsys):
    assert main(["import", "deform", str(folder), "--up", "y", "--out", str(tmp_path / "log.npz")]) == 2
    assert "state that z is up" in capsys.readouterr().err


def test_a_wrong_name_for_the_log_is_refused(folder, capsys):
    assert main(["import", "deform", str(folder), "--out", "log.csv"]) == 2
    assert "ends in .npz" in capsys.readouterr().err
