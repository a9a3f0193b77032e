"""The page of supported versions: what was tested, and how far the simulators are from the first corner's."""

import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import versions


def corner(mujoco: str, failures: int, end: list[float]) -> dict:
    counts = {"tests": 40, "skipped": 3, "failures": failures, "errors": 1}
    shown = {"mujoco": mujoco, "mujoco-mjx": "3.17.0", "jax": "0.10.2"}
    return {"python": "3.11", "versions": shown, **counts, "motions": {"MJX, plane": [[0.0, 0.0], end]}}


def test_page_counts_tests_and_states_the_largest_distance():
    lines = versions.page([corner("3.17.0", 0, [0.5, 0.0]), corner("4.0.0", 2, [0.5003, 0.0004])], ["a.py"])
    assert "| 3.11 | 3.17.0 | 3.17.0 | 0.10.2 | 36 | 3 | 1 |" in lines
    assert "| 3.11 | 4.0.0 | 3.17.0 | 0.10.2 | 34 | 3 | 3 |" in lines
    assert "| MJX, plane | 5.0e-04 |" in lines


def test_keypoints_of_another_number_are_refused():
    with pytest.raises(ValueError, match="shorter"):
        versions.furthest([[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0]])


def test_without_uv_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(versions.shutil, "which", lambda *_, **__: None)
    with pytest.raises(SystemExit, match="pip install uv"):
        versions.run_corner(versions.CORNERS[0], ["tests/test_cli.py"], 0)
