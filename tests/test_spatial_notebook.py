"""The notebook on a real cable: ten cells that run as they stand."""

from __future__ import annotations

import json
import os
import pathlib
import re

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
    assert change.startswith("In files 102 to 106, keypoints 0 and 1 at gripper 0 ")
    here, usual = map(float, re.findall(r"([\d.]+) mm", change))
    assert 21 < here < 22.5 and 28.5 < usual < 30.5
