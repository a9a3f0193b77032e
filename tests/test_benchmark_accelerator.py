"""The accelerator's benchmark: what it measures, keeps and writes, at a small size on the processor."""

import dataclasses
import json
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import accelerator
from accelerator_page import page
from accelerator_sections import ENGINES, SECTIONS, Sizes
from energy import EnergyMeter

from cablejax.cable import Discretisation
from cablejax.dynamics.graph import build_graph, prior_of
from dynamics_cases import SMALL, arched_history


@pytest.fixture
def two_cases(monkeypatch):
    """The section `rollout` of C MuJoCo alone, which needs no compiling of JAX programs."""
    cases = [case for case in SECTIONS["rollout"](Sizes.small()) if case.labels["engine"] not in ENGINES]
    monkeypatch.setitem(SECTIONS, "rollout", lambda sizes: cases)
    return cases


def run(out: pathlib.Path) -> tuple[list[str], str]:
    accelerator.main(["--small", "--only", "rollout", "--out", str(out)])
    return out.with_suffix(".jsonl").read_text().splitlines(), out.read_text()


@pytest.mark.slow
def test_a_killed_run_goes_on_and_repeats_nothing(tmp_path, two_cases):
    out = tmp_path / "page.md"
    lines, text = run(out)
    assert [json.loads(line)["case"] for line in lines] == [case.name for case in two_cases]
    for line in lines:
        record = json.loads(line)
        assert len(record["seconds"]) == Sizes.small().rounds
        rate = np.median(record["work"] / np.array(record["seconds"]))
        assert f"| {record['engine']} | {record['links']} | {record['batch']} | {float(f'{rate:.3g}'):,.10g} (" in text

    # The second measurement was being written when the run was killed.
    out.with_suffix(".jsonl").write_text(lines[0] + "\n" + lines[1][:50])
    again, _ = run(out)
    assert again[0] == lines[0] and again[1] == lines[1][:50]
    assert json.loads(again[2])["case"] == two_cases[1].name and len(again) == 3
    assert run(out)[0] == again


def test_records_of_another_machine_do_not_count(tmp_path):
    here = accelerator.Records(tmp_path / "records.jsonl", {"device": "here"})
    accelerator.Records(here.path, {"device": "there"}).append({"case": "a", "seconds": [1.0]})
    assert here.read() == {}
    here.append({"case": "a", "seconds": [2.0]})
    assert here.read()["a"]["seconds"] == [2.0]


def test_what_is_short_of_a_goal_is_said():
    common = {"date": "2026-11-22", "prepare_s": 1.0, "bytes": 2**20, "joules": 2.0, "section": "rollout", "links": 33}
    slow = common | {"engine": "MJX", "batch": 64, "work": 1e5, "seconds": [0.5, 1.0, 1.0]}
    fast = common | {"engine": "chain", "batch": 512, "work": 1e7, "seconds": [1.0]}
    full = {"date": "2026-11-22", "section": "rollout", "links": 33, "engine": "MJX", "batch": 9, "failure": "no room"}
    text = page([slow, fast, full], {"device": "d", "machine": "m", "versions": "v", "sizes": "small"})
    assert "accelerator.py --small --out" in text
    assert "| 100,000, batch 64 | no, 10 times short |" in text
    assert "| 10 million, batch 512 | yes |" in text
    assert "100,000 (100,000 to 200,000; 3) | 1 MiB | 20 J |" in text
    assert "| MJX | 33 | 9 | no room |" in text


def test_energy_is_counted_or_absent():
    meter = EnergyMeter()
    first, second = meter.joules(), meter.joules()
    assert (first is None and second is None) or 0 <= first <= second


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "MJX" else ()) for name in ENGINES]
)
def test_an_engine_asks_for_full_precision(name):
    # On a GPU JAX multiplies matrices in TF32 unless it is asked not to.
    function, arguments, steps = ENGINES[name](Discretisation(n_links=6), 3, 1)
    assert steps >= 3 * 50
    products = [
        equation
        for equation in equations(jax.make_jaxpr(function)(*arguments).jaxpr)
        if equation.primitive.name == "dot_general"
    ]
    highest = jax.lax.Precision.HIGHEST
    assert products and {equation.params["precision"] for equation in products} == {(highest, highest)}


def test_what_a_network_sees_is_computed_in_full_precision():
    config = dataclasses.replace(SMALL, prior="static")

    def seen(history, twist):
        return build_graph(history, twist, prior_of(history, twist, config), config).nodes

    program = jax.make_jaxpr(seen)(arched_history(config), jnp.zeros((2, 3)))
    products = [one for one in equations(program.jaxpr) if one.primitive.name == "dot_general"]
    highest = jax.lax.Precision.HIGHEST
    assert len(products) > 5 and {one.params["precision"] for one in products} == {(highest, highest)}


def equations(jaxpr):
    """The equations of a program and of all programs inside it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from equations(inner)


@pytest.mark.slow
def test_every_section_is_measured(tmp_path):
    out = tmp_path / "page.md"
    accelerator.main(["--small", "--minutes", "60", "--out", str(out)])
    names = {json.loads(line)["section"] for line in out.with_suffix(".jsonl").read_text().splitlines()}
    assert names == set(SECTIONS)
    assert out.read_text().count("\n## ") == 1 + len(SECTIONS)
