"""The notebook on a real cable: ten cells that run as they stand."""

from __future__ import annotations

import json
import os
import pathlib

import pytest

_NOTEBOOK = pathlib.Path(__file__).parents[1] / "notebooks" / "04_real_cable.ipynb"
_DATA = pathlib.Path(os.environ.get("CABLEJAX_DATA", "nowhere")) / "deform" / "DLO2.npz"


def _code() -> list[str]:
    cells = json.loads(_NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert len(cells) == 10
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_has_ten_cells_of_valid_code():
    for source in _code():
        compile(source, str(_NOTEBOOK), "exec")


@pytest.mark.slow
@pytest.mark.skipif(
    not _DATA.is_file(), reason="$CABLEJAX_DATA/deform/DLO2.npz is absent: the recordings are not shipped"
)
def test_runs_up_to_the_diagnosis():
    names: dict = {}
    for source in _code():
        if "diagnose_space" in source:
            break
        exec(compile(source, str(_NOTEBOOK), "exec"), names)
    (change,) = names["local_changes"](names["log"], names["windows"].held)
    assert change.files == ("102", "103", "104", "105", "106")
    assert change.pair == (0, 1) and change.gripper == 0
    assert 0.021 < change.here < 0.0225 and 0.0285 < change.usual < 0.0305
