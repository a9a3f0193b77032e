"""The examples on the concept pages, as a reader would run them."""

import pathlib
import re

import numpy as np
import pytest

from cablejax.effects.given import EFFECTS, parameter_units
from cablejax.simulate import ENGINES

PAGES = pathlib.Path(__file__).parents[1] / "docs" / "concepts"
COMPILE = pytest.mark.slow


def example(page: str) -> dict:
    """What the page's one block of Python leaves behind."""
    [code] = re.findall(r"```python\n(.*?)```", (PAGES / page).read_text(encoding="utf-8"), re.DOTALL)
    defined: dict = {}
    exec(compile(code, page, "exec"), defined)
    return defined


def test_simulate(capsys):
    assert example("simulate.md")["trajectory"].keypoints.shape == (6, 13, 2)
    assert capsys.readouterr().out


def test_the_table_of_effects_is_that_of_the_library():
    page = (PAGES / "simulate.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in page.splitlines() if row.startswith("| `")]
    said = {name.strip("`"): (set(re.findall(r"`(\w+)`", taken)), hook, there) for name, taken, _, hook, there in rows}
    engines = {"chain": "chain", "mjx": "MJX", "threaded": "C"}
    assert said == {
        name: (
            set(parameter_units(effect)),
            effect.hook,
            ", ".join(word for engine, word in engines.items() if effect.hook in ENGINES[engine].hooks),
        )
        for name, effect in EFFECTS.items()
    }


def test_plants(capsys):
    seen = example("plants.md")["seen"]
    assert seen.time == pytest.approx(1.0) and np.isfinite(seen.keypoints).all() and capsys.readouterr().out


def test_correct(capsys):
    made = example("correct.md")
    left = np.asarray(made["apply"](made["residual"], made["twist"][-1])) - made["error"][-1]
    # the penalty leaves a part of so small motions
    assert np.abs(left).max() < np.abs(made["error"][-1]).max() / 3 and capsys.readouterr().out


@COMPILE
def test_learn(capsys):
    displacement = np.asarray(example("learn.md")["displacement"])
    np.testing.assert_allclose(displacement[[0, -1], 0], [0.02, -0.02], atol=1e-6)
    assert displacement.shape == (13, 2) and capsys.readouterr().out


@COMPILE
def test_control(capsys):
    made = example("control.md")
    assert np.asarray(made["twist"]).shape == (2, 3) and np.abs(made["twist"]).max() > 1e-3 and capsys.readouterr().out
