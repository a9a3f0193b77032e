"""The page of supported versions: what was tested, and how far the simulators are from the first corner's."""

import json
import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import versions


def corner(mujoco: str, failures: int, end: list[float]) -> dict:
    counts = {"tests": 40, "skipped": 3, "failures": failures, "errors": 1, "broken": ["a.py.test_of"]}
    shown = {"mujoco": mujoco, "mujoco-mjx": "3.17.0", "jax": "0.10.2"}
    return {
        "python": "3.11",
        "commit": "4d4ffeb",
        "versions": shown,
        **counts,
        "motions": {"MJX, plane": [[0.0, 0.0], end]},
    }


def test_page_counts_tests_and_states_the_largest_distance():
    lines = versions.page([corner("3.17.0", 0, [0.5, 0.0]), corner("4.0.0", 2, [0.5003, 0.0004])], ["a.py"])
    assert "| 3.11 | 3.17.0 | 3.17.0 | 0.10.2 | 36 | 3 | 1 | 4d4ffeb |" in lines
    assert "| 3.11 | 4.0.0 | 3.17.0 | 0.10.2 | 34 | 3 | 3 | 4d4ffeb |" in lines
    assert "| MJX, plane | 5.0e-04 |" in lines
    assert "2 of 6 corners" in lines and "Failed on 3.11 / 4.0.0 / 0.10.2: `a.py.test_of`." in lines


def test_corners_that_are_not_run_are_on_the_page_as_they_were(tmp_path, monkeypatch):
    def run(which, tests, workers):
        results = versions.results_of(which)
        results.mkdir(parents=True)
        (results / "corner.json").write_text(json.dumps(corner("4.0.0", 0, [0.5, 0.0])))

    monkeypatch.setattr(versions, "BUILD", tmp_path)
    monkeypatch.setattr(versions, "run_corner", run)
    for number, shown in (("2", 1), ("4", 2)):
        with pytest.raises(SystemExit, match="tests failed"):
            versions.main(["--only", number, "--out", str(tmp_path / "page.md"), "a.py"])
        assert (tmp_path / "page.md").read_text().count("| 3.11 | 4.0.0 |") == shown


def test_keypoints_of_another_number_are_refused():
    with pytest.raises(ValueError, match="shorter"):
        versions.furthest([[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0]])


def test_without_uv_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(versions.shutil, "which", lambda *_, **__: None)
    with pytest.raises(SystemExit, match="pip install uv"):
        versions.run_corner(versions.CORNERS[0], ["tests/test_cli.py"], 0)
