"""Commands that did not end: the same one goes on, whatever was written, and files of the user's own stay."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest

from cablejax.cli import main
from cablejax.commands import diagnose, runs
from cablejax.commands.options import UsageError
from cablejax.commands.resuming import Parts, unfinished
from cablejax.commands.runs import Job
from cablejax.control.shaping import load_model
from cablejax.control.targets import make_target
from cablejax.simulate.plant import PlantConfig
from cablejax.text_file import write_json
from cli_cases import made_up_run, small_model

TARGET = make_target("U")
SETTINGS = {"steps": 2}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return small_model(tmp_path_factory.mktemp("model"))


@pytest.fixture
def made(monkeypatch):
    """Runs cost nothing here; this is what was made."""
    made = []

    def quick(plant, model, target, *, method, **_):
        made.append(method)
        return made_up_run(target)

    monkeypatch.setattr(runs, "shape_once", quick)
    return made


def interrupted(*args, **kwargs):
    raise KeyboardInterrupt


def assert_same(run, other):
    for field in dataclasses.fields(run):
        one, two = getattr(run, field.name), getattr(other, field.name)
        assert_same(one, two) if dataclasses.is_dataclass(one) else np.testing.assert_array_equal(one, two)


def test_a_run_comes_back_as_it_was_kept(tmp_path):
    parts, run = Parts(tmp_path / "parts", SETTINGS), made_up_run(TARGET)
    parts.begin()
    assert parts.differing() == [] and parts.load("U") is None
    parts.save("U", run)
    kept = parts.load("U")
    assert kept is not None
    assert_same(kept, run)
    parts.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_run_is_made_again(tmp_path, capsys):
    parts = Parts(tmp_path / "parts", SETTINGS)
    parts.begin()
    parts.save("U", made_up_run(TARGET))
    (file,) = parts.folder.glob("*.npz")
    whole = file.read_bytes()
    for damaged in (b"", whole[:-30], whole[: len(whole) // 2], whole[:200] + bytes(100) + whole[300:]):
        file.write_bytes(damaged)
        assert parts.load("U") is None
        assert "is damaged and made again" in capsys.readouterr().err


def test_settings_that_cannot_be_read_are_reported(tmp_path):
    parts = Parts(tmp_path / "parts", SETTINGS)
    parts.begin()
    for text in ("", '{"schema": ', "[" * 100_000):
        (parts.folder / "settings.json").write_text(text)
        with pytest.raises(UsageError, match=r"settings\.json is .* Delete .*parts to start again"):
            parts.differing()


def test_parts_of_other_settings_are_refused_or_replaced(tmp_path):
    with pytest.raises(KeyboardInterrupt), unfinished(tmp_path, SETTINGS, overwrite=False) as parts:
        parts.save("U", made_up_run(TARGET))
        raise KeyboardInterrupt
    with unfinished(tmp_path, SETTINGS, overwrite=False) as parts:
        assert parts.load("U") is not None
        parts.save("S", made_up_run(TARGET))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), unfinished(tmp_path, SETTINGS, overwrite=False) as parts:
        parts.save("U", made_up_run(TARGET))
        raise KeyboardInterrupt
    with (
        pytest.raises(UsageError, match=r"unfinished run with other options \(steps\)"),
        unfinished(tmp_path, {"steps": 3}, overwrite=False),
    ):
        pass
    with unfinished(tmp_path, {"steps": 3}, overwrite=True) as parts:
        assert parts.load("U") is None


def test_input_that_is_refused_leaves_the_folder_free(tmp_path):
    for out in (tmp_path, tmp_path / "new"):
        with pytest.raises(ValueError, match="no good"), unfinished(out, SETTINGS, overwrite=False):
            raise ValueError("no good")
        assert list(tmp_path.iterdir()) == []


def test_a_kill_while_progress_is_removed_leaves_finished_results_finished(tmp_path, monkeypatch):
    unlink = pathlib.Path.unlink

    def killed(path, **_):
        unlink(path)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), unfinished(tmp_path, SETTINGS, overwrite=False) as parts:
        write_json(parts.state, {"rounds": 3})
        (tmp_path / "report.html").write_text("whole")
        monkeypatch.setattr(pathlib.Path, "unlink", killed)
    monkeypatch.undo()
    assert parts.folder.exists()
    with pytest.raises(UsageError, match="is not empty"), unfinished(tmp_path, SETTINGS, overwrite=False):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_input_that_is_refused_leaves_finished_results_finished(tmp_path):
    (tmp_path / "report.html").write_text("of an earlier run")
    with pytest.raises(ValueError, match="no good"), unfinished(tmp_path, SETTINGS, overwrite=True):
        raise ValueError("no good")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(ValueError, match="no good"), unfinished(tmp_path, SETTINGS, overwrite=True):
        (tmp_path / "report.html").write_text("half of another")
        raise ValueError("no good")
    with pytest.raises(ValueError, match="no good"), unfinished(tmp_path, SETTINGS, overwrite=False):
        raise ValueError("no good")
    assert (tmp_path / "parts").exists(), "the page is not finished"


@pytest.mark.parametrize("name", ["photos.txt", "settings.json", "U-residual.npz"])
def test_a_folder_of_that_name_that_is_a_users_own_stays(name, made, weights, tmp_path, capsys):
    mine = tmp_path / "parts" / name
    mine.parent.mkdir()
    mine.write_text('{"mine": 1}')
    arguments = ["shape", "--weights", str(weights), "--out", str(tmp_path), "--target", "U", "--steps", "2"]
    for more in ([], ["--overwrite"]):
        assert main([*arguments, *more]) == 2
        assert "parts was not made by this command" in capsys.readouterr().err
        assert mine.read_text() == '{"mine": 1}' and not made


def test_files_that_a_user_put_between_the_parts_stay(tmp_path):
    parts = Parts(tmp_path / "parts", SETTINGS)
    parts.begin()
    mine = {"notes.txt", "film.part"}
    for name in mine:
        (parts.folder / name).write_text("mine")
    (parts.folder / "U.run.npz.part").write_text("killed here")
    Parts(tmp_path / "parts", {"steps": 3}).begin()
    parts.remove()
    assert {file.name for file in parts.folder.iterdir()} == mine


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("begun", [False, True])
def test_a_kill_before_the_settings_are_whole_is_no_foreign_folder(begun, overwrite, tmp_path):
    (tmp_path / "parts").mkdir()
    if begun:
        (tmp_path / "parts" / "settings.json.part").write_text("{")
    with unfinished(tmp_path, SETTINGS, overwrite=overwrite) as parts:
        assert parts.differing() == []
    assert list(tmp_path.iterdir()) == []


def test_shape_goes_on_after_ctrl_c_between_its_results(made, weights, tmp_path, capsys, monkeypatch):
    arguments = ["shape", "--weights", str(weights), "--out", str(tmp_path), "--target", "U", "--steps", "2"]
    with monkeypatch.context() as patch:
        patch.setattr("cablejax.commands.results.write_page", interrupted)
        assert main(arguments) == 130
    shown = capsys.readouterr().err
    assert shown.startswith("compiling the control step ...\n") and "Run the same command again" in shown
    assert (tmp_path / "log.npz").exists() and not (tmp_path / "summary.json").exists()
    assert main(arguments) == 0
    assert made == ["residual", "direct"], "no run was repeated"
    assert "compiling" not in capsys.readouterr().err
    assert {file.name for file in tmp_path.iterdir()} == {"demo.gif", "log.npz", "report.html", "summary.json"}
    assert main(arguments) == 2, "the command has ended"


def test_demo_goes_on_after_ctrl_c_in_its_diagnosis(made, weights, tmp_path, capsys, monkeypatch):
    arguments = ["demo", "--weights", str(weights), "--out", str(tmp_path), "--shapes", "U", "--steps", "2"]

    def half_written(log, folder, **_):
        (folder / "verdict.json").write_text("{}")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(diagnose, "diagnose_and_report", half_written)
        assert main(arguments) == 130
    assert "Run the same command again" in capsys.readouterr().err
    again = []

    def refused(log, folder, **_):
        from cablejax.diagnose import DiagnosisError

        again.append(folder)
        raise DiagnosisError("too short")

    monkeypatch.setattr(diagnose, "diagnose_and_report", refused)
    (tmp_path / "diagnosis" / "report.html").write_text("of another run")
    (tmp_path / "diagnosis" / "notes.txt").write_text("mine")
    assert main(arguments) == 0
    assert made == ["residual", "direct"] and again == [tmp_path / "diagnosis"]
    assert [path.name for path in again[0].iterdir()] == ["notes.txt"], "no diagnosis of another run"
    assert not (tmp_path / "parts").exists()


def test_parts_are_of_these_weights_and_no_others(tmp_path):
    first, same, other = (small_model(tmp_path / str(k), seed) for k, seed in enumerate((0, 0, 1)))

    def settings(folder):
        job = Job(
            plant=PlantConfig(),
            model=load_model(str(folder)),
            targets=(TARGET,),
            methods=("direct",),
            solver="levenberg-marquardt",
            steps=2,
        )
        return json.dumps(job.settings())

    assert settings(first) == settings(same) != settings(other)
