"""`cablejax view` finds out by content what a file is, and its page answers what a stranger asks first."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest

from cablejax.cable import Cable
from cablejax.cable_file import write_cable
from cablejax.cli import main
from cablejax.commands.cable import find_cable
from cablejax.dataset.opening import open_or_create
from cablejax.dataset.schema import DatasetConfig
from cablejax.diagnose.diagnosis import NamedEffect, ParameterEstimate
from cablejax.diagnose.verdict_json import read_verdict, verdict_json, write_verdict
from cablejax.dynamics.weights import FILE_NAME
from cablejax.gaplog import TARGETS, targets_of, write_gap_log
from cablejax.report.log_sheet import log_sheet
from cli_cases import small_model
from test_dataset_store import SMALL, block
from test_diagnose_report import CURVED, diagnosis
from test_export import in_space, planar
from test_report import demo_runs


def view(capsys, *arguments) -> tuple[dict, str]:
    """The command's answer, and its page."""
    assert main(["view", *map(str, arguments), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    with open(answer["page"], encoding="utf-8") as page:
        return answer, page.read()


def refused(capsys, *arguments) -> str:
    assert main(["view", *map(str, arguments)]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("log", "said"),
    [
        (planar, ["2 episodes of a cable of 1 m on a table", "approach_u", "10 per second", "91.58 %", "to 0.00"]),
        (in_space, ["1 episode of a cable of 1 m in space", "swing", "100 per second", "100 %", "9 keypoints"]),
    ],
)
def test_a_log(log, said, tmp_path, capsys):
    # the name says nothing of its content
    path = write_gap_log(tmp_path / "log.npz", log()).rename(tmp_path / "recording.dat")
    answer, page = view(capsys, path)
    assert answer["kind"] == "log" and answer["page"] == str(tmp_path / "recording.html")
    for words in said:
        assert words in page, words
    assert not re.search(r'(src|href)="(?!#|data:)', page) and page.count("<svg") == 2
    assert "exists" in refused(capsys, path)
    view(capsys, path, "--overwrite")


def test_a_log_whose_episodes_were_recorded_at_two_rates():
    log = planar()
    log.time[1] *= 2.0
    assert log_sheet(log, "log.npz").cards[0] == ("Samples", "21", "5 to 10 per second")


def test_episodes_without_a_name_of_their_own_are_numbered_in_the_figures():
    log = dataclasses.replace(planar(), meta={**planar().meta, "motion": ["recorded"] * 2})
    (shapes, said), (course, _) = log_sheet(log, "log.npz").figures
    assert [ax.get_title("left") for ax in shapes.axes if ax.get_visible()] == ["0: recorded", "1: recorded"]
    assert [text.get_text() for text in course.legends[0].get_texts()] == ["0: recorded", "1: recorded"]
    assert "target" in said and "target" not in "".join(words for _, words in log_sheet(in_space(), "log.npz").figures)


def test_the_noise_of_a_log_is_estimated(tmp_path, capsys):
    _, page = view(capsys, write_gap_log(tmp_path / "log.npz", diagnosis().log))
    noise = float(re.search(r"Noise of a coordinate</h3><p>([\d.]+) mm", page)[1])
    assert noise == pytest.approx(1.0, abs=0.1)


def test_an_exported_log(tmp_path, capsys):
    pytest.importorskip("mcap", reason="mcap is not installed: pip install 'cablejax[recordings]'")
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'cablejax[recordings]'")
    from cablejax.recordings.lerobot import write_lerobot
    from cablejax.recordings.mcap_log import write_mcap

    for path in (write_mcap(tmp_path / "a.bin", planar()), write_lerobot(tmp_path / "set", planar())):
        answer, page = view(capsys, path)
        assert "2 episodes" in answer["title"] and "approach_u" in page


def test_a_data_set(tmp_path, capsys):
    config = dataclasses.replace(SMALL, n_steps=3)
    store = open_or_create(tmp_path / "data.zarr", config)
    _, page = view(capsys, store.path, "--out", tmp_path / "empty.html")
    assert "0 of 7" in page and "7 are missing" in page and "<svg" not in page
    store.write_shard(1, block(config, 1))
    answer, page = view(capsys, store.path)
    assert answer["page"] == str(tmp_path / "data.html")
    for words in ("3 of 7", "4 are missing", "first shard, 3 trajectories", "it resumes where it stopped"):
        assert words in page, words
    assert page.count("<svg") == 1


def test_weights(tmp_path, capsys):
    model = small_model(tmp_path / "model", cable=Cable(length=0.8))
    answer, page = view(capsys, model)
    assert answer["page"] == str(tmp_path / "model.html") and "a cable of 0.8 m" in answer["title"]
    assert "graph network of 1 message-passing steps, latent size 8" in page and "the rigid prior" in page
    (model / "metrics.csv").write_text("step,loss,open_loop_1_cm\n50,1.0,\n100,0.5,0.02\n150,0.25,\n")
    (model / "card.md").write_text("# The <card>")
    _, page = view(capsys, model / FILE_NAME)
    assert "# The &lt;card&gt;" in page and "open-loop error [cm]" in page


def test_a_released_model(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    answer, page = view(capsys, "gns-reference")
    assert answer["page"] == "gns-reference.html" and "Accuracy on held-out trajectories" in page


def test_a_cable(tmp_path, capsys):
    write_cable(tmp_path / "cable.txt", Cable(length=0.7, bending_stiffness=0.004))
    answer, page = view(capsys, tmp_path / "cable.txt")
    assert answer["kind"] == "cable" and "0.004 N m²" in page and "A cable of 0.7 m" in page


@pytest.mark.parametrize("verdict", ["none", "named", "unknown"])
def test_a_verdict(verdict, tmp_path, capsys):
    made = diagnosis(verdict, **({} if verdict == "named" else {"effects": ()}))
    write_verdict(tmp_path / "verdict.json", made)
    answer, page = view(capsys, tmp_path / "verdict.json")
    assert answer["title"] == f"Verdict: {made.sentence}"
    assert ("1.25 1/m (1.10 to 1.40)" in page) == (verdict == "named") and "3.7" in page
    again = verdict_json(read_verdict(tmp_path / "verdict.json"))
    first = verdict_json(made)
    for key in ("verdict", "sentence", "effects", "equivalent", "ranking", "leftover_p", "gap", "caveats", "baselines"):
        if key != "gap" or verdict != "unknown":  # nothing shrinks there, and what would have is not repeated
            assert again[key] == first[key], key


def test_a_damaged_verdict_is_refused(tmp_path, capsys):
    made = verdict_json(diagnosis(effects=(CURVED,)))
    unlikely = {"ranking": [made["ranking"][0] | {"probability": 10**30}]}
    for change in (
        {"gap": None},
        {"ranking": [{"name": 3}]},
        {"effects": [{"name": "x", "parameters": []}]},
        unlikely,
        {"leftover_p": -0.1},
    ):
        (tmp_path / "verdict.json").write_text(json.dumps(made | change))
        assert "is a damaged verdict" in refused(capsys, tmp_path / "verdict.json")


def test_pages_advise_only_commands_that_accept_the_file(tmp_path, capsys):
    softer = NamedEffect("bending_stiffness", 0.9, {"ratio": ParameterEstimate(0.5, (0.4, 0.6), "")}, {})
    write_verdict(tmp_path / "verdict.json", diagnosis(effects=(softer,)))
    assert "cablejax simulate --with" in view(capsys, tmp_path / "verdict.json")[1]
    stated = json.loads((tmp_path / "verdict.json").read_text())
    (tmp_path / "verdict.json").write_text(json.dumps(stated | {"dimension": 3}))
    assert "cablejax simulate" not in view(capsys, tmp_path / "verdict.json", "--overwrite")[1]
    motion = dataclasses.replace(planar(), keypoints=np.full_like(planar().keypoints, np.nan))
    _, page = view(capsys, write_gap_log(tmp_path / "next_motion.npz", motion))
    assert "cablejax shape --motion" in page and "cablejax diagnose" not in page

    uneven = Cable(n_keypoints=4, marks=(0.0, 0.2, 0.7, 1.0))
    write_cable(tmp_path / "cable.toml", uneven)
    _, page = view(capsys, tmp_path / "cable.toml", "--out", tmp_path / "cable.html")
    assert "keypoints = 4" in page and "cablejax train" not in page
    cut = dataclasses.replace(SMALL.discretisation, cable=uneven)
    for config, trained in ((SMALL, True), (dataclasses.replace(SMALL, discretisation=cut), False)):
        config = dataclasses.replace(config, n_steps=3)
        store = open_or_create(tmp_path / f"{trained}.zarr", config)
        for shard in range(3):
            store.write_shard(shard, block(config, shard))
        assert ("cablejax train" in view(capsys, store.path)[1]) == trained


def test_a_run_has_its_page(tmp_path, capsys):
    from cablejax.commands.results import numbers_of, write_results

    runs = demo_runs()
    write_results(tmp_path, runs, numbers_of(runs), believed=Cable(), about="Test.", facts={})
    (tmp_path / "summary.json").write_text("{}")
    answer, page = view(capsys, tmp_path)
    assert answer["page"] == str(tmp_path / "report.html") and "The cable reaches" in page
    _, copy = view(capsys, tmp_path, "--out", tmp_path / "copy.html")
    assert copy == page
    # its log states the targets, which the log's own page shows
    _, page = view(capsys, tmp_path / "log.npz")
    assert "distance to the target" in page
    assert find_cable(tmp_path) == Cable()


def test_a_diagnosis_has_its_page(tmp_path, capsys):
    from cablejax.report.diagnosis_page import write_diagnosis_page

    page = write_diagnosis_page(diagnosis(), tmp_path / "report")
    assert view(capsys, tmp_path / "report")[0]["page"] == str(page)


def test_what_is_none_of_ours_is_refused(tmp_path, capsys):
    (tmp_path / "a.txt").write_text("hello, world")
    (tmp_path / "b.json").write_text('{"schema": "other/1"}')
    (tmp_path / "c.bin").write_bytes(bytes(range(256)))
    (tmp_path / "d").write_text("")
    (tmp_path / "e.conf").write_text("colour = 3")
    (tmp_path / "folder").mkdir()
    np.savez(tmp_path / "f.zip.npz", x=np.zeros(3))
    shutil.move(tmp_path / "f.zip.npz", tmp_path / "f.zip")
    for name, words in {
        "a.txt": "is a text that begins with 'hello, world'",
        "c.bin": "is a file that begins with",
        "d": "is an empty file",
        "e.conf": "is a TOML file with the keys ['colour']",
        "f.zip": "is an archive without the array 'meta'",
        "folder": "is a folder, and holds nothing",
    }.items():
        said = refused(capsys, tmp_path / name)
        assert words in said and "Expected a gap log" in said and "cablejax import" in said, name
    # by its name a verdict, whose reader says more
    assert "has schema 'other/1', expected 'cablejax-verdict/1'" in refused(capsys, tmp_path / "b.json")
    assert "There is no file or folder" in refused(capsys, tmp_path / "absent.npz")
    (tmp_path / "folder" / "parts").mkdir()
    assert "unfinished run" in refused(capsys, tmp_path / "folder")
    write_cable(tmp_path / "cable.toml", Cable())
    assert "ends in .html" in refused(capsys, tmp_path / "cable.toml", "--out", tmp_path / "page.pdf")


def test_targets_that_are_none_are_left_out():
    log = planar()
    for stated in (None, 3, [], [[1.0], "x"], [[[None, 1.0]] * 13, [[np.inf, 0.0]] * 13]):
        assert targets_of(dataclasses.replace(log, meta=log.meta | {TARGETS: stated})) == [None, None]


def test_only_the_first_shard_of_a_data_set_is_read(tmp_path, capsys, monkeypatch):
    from cablejax.dataset.store import Store

    config = DatasetConfig(n_trajectories=7, n_steps=2, shard_size=1, discretisation=SMALL.discretisation)
    store = open_or_create(tmp_path / "data.zarr", config)
    for shard in range(7):
        store.write_shard(shard, block(config, shard))
    read, whole = [], Store.read_shard
    monkeypatch.setattr(Store, "read_shard", lambda self, shard: (read.append(shard), whole(self, shard))[1])
    view(capsys, store.path)
    assert read == [0]


def test_a_log_with_a_target_in_which_nothing_was_observed(tmp_path, capsys):
    log = planar()
    log = dataclasses.replace(log, keypoints=np.full_like(log.keypoints, np.nan))
    _, page = view(capsys, write_gap_log(tmp_path / "log.npz", log))
    assert "not seen to not seen" in page and "nan to" not in page


def test_a_verdict_with_a_name_as_long_as_a_page_has_a_page(tmp_path, capsys):
    content = verdict_json(diagnosis())
    content["ranking"][1] |= {"name": "x" * 5000, "outcome": 10**400}
    (tmp_path / "verdict.json").write_text(json.dumps(content))
    _, page = view(capsys, tmp_path / "verdict.json")
    assert "x" * 60 in page
