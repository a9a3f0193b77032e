"""Hanging wires: made up in the format of the published archive, and the real ones where they are."""

import numpy as np
import pytest

from real_cables.wires import read_wires
from recording_cases import DATA, needs_wires


def fields() -> dict[str, np.ndarray]:
    angle = np.linspace(0, np.pi, 11)
    arc = np.stack([0.3 * np.cos(angle), 0 * angle, -0.3 * np.sin(angle)], axis=-1)
    return {
        "wire": np.array(["white", "black"]),
        "keypoints": np.broadcast_to(arc, (2, 3, 11, 3)).astype(np.float32),
        "length_m": np.float64(0.3 * np.pi),
        "mass_per_length_kg_m": np.array([0.02, 0.03]),
        "EI_published_Nm2": np.array([[1e-4, 2e-4, 3e-4], [1e-3, 1e-3, 1e-3]]),
    }


def test_wires_are_read_with_what_was_published(tmp_path):
    np.savez(tmp_path / "wires.npz", **fields())
    white, black = read_wires(tmp_path / "wires.npz")
    assert (white.name, black.name) == ("white", "black") and black.linear_density == 0.03
    assert white.keypoints.shape == (3, 11, 3) and white.length == pytest.approx(0.3 * np.pi)
    assert white.published_stiffness.tolist() == [1e-4, 2e-4, 3e-4]
    np.savez(tmp_path / "wires.npz", **(fields() | {"length_m": np.array(1)}))
    assert read_wires(tmp_path / "wires.npz")[0].length == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keypoints": None}, "lacks keypoints"),
        ({"keypoints": np.zeros((2, 11, 3))}, r"keypoints has shape \(2, 11, 3\)"),
        ({"keypoints": np.full((2, 3, 11, 3), np.nan)}, "has values that are not finite"),
        (
            {"mass_per_length_kg_m": np.array([0.02, -0.03])},
            "mass_per_length_kg_m has the value -0.03, expected positive",
        ),
        ({"EI_published_Nm2": np.zeros((2, 3))}, "EI_published_Nm2 has the value 0, expected positive"),
        ({"wire": np.array(["white"])}, r"wire has shape \(1,\), expected \(2,\)"),
        ({"EI_published_Nm2": np.zeros((2, 5))}, r"EI_published_Nm2 has shape \(2, 5\), expected \(2, 3\)"),
        ({"length_m": np.float64(1500.0)}, "1.5 m if they are in mm"),
    ],
)
def test_wrong_archives_are_refused(tmp_path, change, message):
    np.savez(tmp_path / "wires.npz", **{n: v for n, v in (fields() | change).items() if v is not None})
    with pytest.raises(ValueError, match=message):
        read_wires(tmp_path / "wires.npz")


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "wires.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"is no \.npz archive"):
        read_wires(tmp_path / "wires.npz")


@needs_wires
def test_real_wires_are_read():
    wires = read_wires(DATA / "hanging_wires" / "wires.npz")
    assert [wire.name for wire in wires] == ["white", "black", "red"]
    for wire in wires:
        assert wire.keypoints.shape == (5, 51, 3) and wire.length == 1.5
