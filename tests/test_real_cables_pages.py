"""Any folder of recordings is read, cut, scored and written up."""

from __future__ import annotations

import dataclasses
import importlib
import pickle

import numpy as np
import pytest

import spatial_cases as cases
from cablejax.recordings.deform import DeformRecordings, repaired_blocks
from cablejax.spatial.windows import windows_of
from real_cables import benchmark, network
from real_cables.benchmark import errors_of, spread_of
from real_cables.page import Notes, errors_figure, page, read_published
from real_cables.protocol import cables_in, protocol_windows
from recording_cases import DT, swinging

script = importlib.import_module("30_real_cables")


def blocks(count: int = 4, split: str = "") -> DeformRecordings:
    points = np.stack([swinging(seed=k, phase=k) for k in range(count)])
    names = np.arange(count)
    return DeformRecordings(points, DT, np.full(count, split), names, names, "cord")


def test_cables_of_a_folder_are_named_by_it(tmp_path):
    np.savez(tmp_path / "rope.npz", a=1)
    for folder in ("hose/train", "hose/eval", "wire"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "1.pkl").write_bytes(pickle.dumps(np.zeros((3, 3, 9))))
    (tmp_path / "cord").mkdir()
    np.savez(tmp_path / "cord" / "all.npz", a=1)
    (tmp_path / "notes").mkdir()
    found = cables_in(tmp_path)
    assert list(found) == ["cord", "hose", "rope", "wire"] and found["cord"].name == "all.npz"
    assert list(cables_in(tmp_path / "hose")) == ["hose"] and list(cables_in(tmp_path / "rope.npz")) == ["rope"]
    with pytest.raises(ValueError, match="holds no recording"):
        cables_in(tmp_path / "notes")


def test_windows_of_recordings_with_gaps():
    whole = protocol_windows(blocks())
    recordings = blocks()
    points = recordings.keypoints
    points[0, 150:] = np.nan  # a shorter block
    points[1, 50:55, 0] = np.nan  # a gripper for a moment
    points[1, 120:150, 8] = np.nan  # and for long
    points[1, 1, 6] = np.nan  # between two samples that show it
    points[2, 0, 4] = np.nan  # not all at the beginning
    points[3, 80:90, 3:6] = np.nan
    windows = protocol_windows(recordings)
    assert windows.name == ("0", "1", "3") and windows.left_out == ("file 2",)
    assert windows.valid.sum(axis=1).tolist() == [150, 120, 200]
    assert np.isfinite(windows.position).all() and np.isfinite(windows.frames).all()
    np.testing.assert_allclose(windows.arclength, whole.arclength, atol=1e-3)
    np.testing.assert_allclose(windows.position[1, 50:55], whole.position[1, 50:55], atol=3e-3)
    np.testing.assert_allclose(windows.keypoints[1, 1, 4], whole.keypoints[1, 1, 4], atol=2e-3)
    assert np.isnan(windows.observed[2, 80:90, 1:4]).all()
    points[:, :, 3] = np.nan
    with pytest.raises(ValueError, match="no block begins"):
        protocol_windows(recordings)


def test_recordings_are_checked_and_repaired_before_they_are_scored_and_no_sample_is_cut():
    right, recordings = blocks(), blocks()
    points = recordings.keypoints
    points[0, 50:90, [3, 4]] = points[0, 50:90, [4, 3]]
    points[1, 100, 5] += [0.0, 0.3, 0.0]
    points[3] = np.nan
    recordings = dataclasses.replace(recordings, keypoints=1000 * points)
    found, repairs = repaired_blocks(recordings)
    assert found.source_id.tolist() == [0, 1, 2] and np.isnan(found.keypoints[1, 100, 5]).all()
    np.testing.assert_allclose(found.keypoints[[0, 2]], right.keypoints[[0, 2]], atol=1e-12)
    assert all(words in " ".join(repairs) for words in ("Block 3", "in mm", "exchanged", "keypoint 5 is farther"))
    assert len(repairs) == 4
    np.testing.assert_allclose(protocol_windows(found).arclength, protocol_windows(right).arclength, atol=1e-3)
    sideways = dataclasses.replace(recordings, keypoints=points[..., [1, 2, 0]])
    with pytest.raises(ValueError, match=r"sags in the direction opposite to y"):
        repaired_blocks(sideways)


def test_a_cable_that_cannot_be_scored_is_named_and_the_others_are_read(tmp_path):
    good = blocks()
    fields = {"dt": good.dt, "split": good.split, "source_id": good.source_id, "recording_guess": good.recording}
    np.savez(tmp_path / "rope.npz", keypoints=good.keypoints, **fields)
    branch = good.keypoints[:, :, 4:5] - np.array([0.0, 0.0, 0.08]) * np.arange(1, 4)[:, None]
    np.savez(tmp_path / "tree.npz", keypoints=np.concatenate([good.keypoints, branch], axis=2), **fields)
    (tmp_path / "torn.npz").write_bytes(b"PK")
    one = {name: value[:1] for name, value in {"keypoints": good.keypoints, **fields}.items() if name != "dt"}
    np.savez(tmp_path / "single.npz", dt=good.dt, **one)
    read, repairs, refused = script._read(tmp_path)
    assert list(read) == ["rope"] and repairs == {"rope": []} and list(refused) == ["single", "torn", "tree"]
    assert "This is a branched cable" in refused["tree"] and "One block may be fitted" in refused["single"]
    text = page({"rope": score(False)}, {}, "errors.png", "where", Notes({"rope": ["Mended."]}, refused))
    assert "- tree is not scored. This is a branched cable" in text and "- rope: Mended." in text
    assert text.index("One procedure") < text.index("## Recordings") < text.index("\n---\n")
    (tmp_path / "rope.npz").unlink()
    with pytest.raises(ValueError, match=r"No cable in .* can be scored: .* This is a branched cable"):
        script._read(tmp_path)


def test_a_lost_window_is_counted_and_does_not_make_the_mean():
    windows = windows_of(cases.recording()).chosen([0, 1, 2, 3] * 5)
    predicted = windows.keypoints + 0.004
    usual = errors_of(predicted, windows)
    predicted[3, 40:] = np.nan
    predicted[4] += 0.5
    found = errors_of(predicted, windows)
    assert (usual.lost, usual.off, usual.windows) == (0, 0, 20) and usual.mean == pytest.approx(usual.plain)
    assert (found.lost, found.off) == (1, 2)
    # 4 mm, of which 6 markers of 10 count; two of twenty windows are ten times as far
    assert found.mean == pytest.approx(2.4 * (18 + 2 * 10) / 20) and found.plain > 3 * found.mean


def test_the_spread_is_that_of_drawing_with_replacement():
    each = np.array([1.0, 1.0, 2.0])
    # without replacement the mean of three of three would not vary at all
    assert spread_of(each, 3) == (1.0, pytest.approx(5 / 3))


def test_what_was_learned_is_learned_again_when_anything_changes(tmp_path, monkeypatch):
    windows = windows_of(cases.recording())
    simulated, asked = windows.keypoints - 0.003, []

    def trained(fitted, windows, progress):
        asked.append(len(windows))
        return network.NetworkResidual(16, 0, None, (), 1.0, fitted, (1.0, 1.0))

    monkeypatch.setattr(benchmark, "fit_network", trained)

    def learn(one=windows, other=simulated):
        return benchmark._learned(other, one, other, one, tmp_path / "half.npz", lambda text: None)

    first, again = learn(), learn()
    assert len(asked) == 1 and first[1] == again[1] == (16, 0)
    for name, predicted in first[0].items():
        np.testing.assert_array_equal(again[0][name], predicted)
    learn(other=simulated + 1e-6)
    learn(one=dataclasses.replace(windows, group=windows.group // 2), other=simulated + 1e-6)
    assert len(asked) == 3
    monkeypatch.setattr(benchmark, "residual", benchmark.features)  # another way to learn
    learn(one=dataclasses.replace(windows, group=windows.group // 2), other=simulated + 1e-6)
    (tmp_path / "half.npz").write_bytes(b"torn")
    learn()
    assert len(asked) == 5


def score(evaluated: bool) -> dict:
    errors = {"mean": 4.0, "plain": 4.0, "lost": 0, "off": 0, "windows": 50}
    on_eval = {"mean": 3.0, "plain": 9.0, "lost": 1, "off": 1, "windows": 7} if evaluated else None
    return {
        "stages": [("nominal", 20.0, 18.0 if evaluated else None)],
        "learned": [("rod", errors | {"mean": 5.0}, on_eval, (1.0, 2.0)), ("rod + ridge", errors, on_eval, (2.5, 3.5))],
        "unsimulated": [("no simulator", errors | {"mean": 50.0}, on_eval)],
        "without_own": on_eval, "estimated": ((0.02, 0.018, 0.022),) * 2,
        "seconds": (0.03, 1.0), "length": 5.0, "left_out": () if evaluated else ("file 7",), "effects": (),
        "networks": ((16, 3),) * 2,
    }  # fmt: skip


def test_a_page_of_any_cables(tmp_path):
    (tmp_path / "published.csv").write_text('method,one,other\n"theirs, as published",9.5,\nneither,,\n')
    published = read_published(tmp_path / "published.csv")
    scores = {"one": score(True), "two": score(False), "three": score(False), "four": score(False)}
    errors_figure(scores, published, tmp_path / "errors.png")
    text = page(scores, published, "errors.png", "where")
    assert (tmp_path / "errors.png").stat().st_size > 5000
    assert text.index("## By recording") < text.index("## Upstream's eval split")
    assert "| **rod + ridge** | **4.0** | **4.0** | **4.0** | **4.0** |" in text
    assert "| no simulator | 50.0 |" in text and "| no simulator | 3.0 (9.0) |" in text
    assert "| theirs, as published | 9.5 |" in text and "neither" not in text and "DLO" not in text
    assert "| **rod + ridge** | **3.0 (9.0)** |" in text and "1 / 0 of 7 |" in text and "7 of 57 for one" in text
    assert "2.5 to 3.5" in text and "1 of two's blocks do not begin" in text
    without = page({"two": score(False)}, published, "errors.png", "where")
    assert "eval [mm]" not in without and "Upstream's eval" not in without
    (tmp_path / "published.csv").write_text("method,one\ntheirs,ten\n")
    with pytest.raises(ValueError, match="no number of millimetres"):
        read_published(tmp_path / "published.csv")
