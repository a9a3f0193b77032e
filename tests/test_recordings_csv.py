"""A laboratory's own csv, with the layout file that the documentation shows."""

import re
from pathlib import Path

import numpy as np
import pytest

from cablejax.gaplog import validate
from cablejax.recordings.table import import_csv
from recording_cases import DT, swinging

DOCUMENTATION = Path(__file__).parents[1] / "docs" / "how_to" / "own_recording.md"

PAIRS = """
[cable]
diameter_m = 0.006
linear_density_kg_per_m = 0.04
bending_stiffness_n_m2 = 6e-4
[frame]
unit = "mm"
[columns]
time = "t"
time_unit = "ms"
keypoint = ["m{i}x", "m{i}y", "m{i}z"]
first = 1
count = 9
"""

PLANAR = """
[cable]
diameter_m = 0.01
linear_density_kg_per_m = 0.08
bending_stiffness_n_m2 = 0.02
bending_damping_s = 0.1
keypoint_arclength_m = [0, 0.2, 0.4, 0.6]
keypoints_on_grippers = "ends"
[table]
friction_coefficient = 0.1
[frame]
unit = "m"
[columns]
time = "t"
keypoint = ["x{i}", "y{i}"]
count = 4
gripper_0 = ["gx0", "gy0", "a0"]
gripper_1 = ["gx1", "gy1", "a1"]
angle_unit = "deg"
episode = "run"
motion = "what"
"""


def written(folder: Path, table: dict[str, np.ndarray], layout: str) -> tuple[Path, Path]:
    """A csv of the columns, and its layout."""
    rows = [",".join(table)]
    for values in zip(*table.values(), strict=True):
        rows.append(",".join("" if v is None or v != v else str(v) for v in values))
    (folder / "run.csv").write_text("\n".join(rows) + "\n")
    (folder / "layout.toml").write_text(layout)
    return folder / "run.csv", folder / "layout.toml"


def in_space() -> dict[str, np.ndarray]:
    points = swinging()
    table = {"t": 1000 * DT * np.arange(200) + 5e5}
    for i in range(9):
        for k, name in enumerate("xyz"):
            table[f"m{i + 1}{name}"] = 1000 * points[:, i, k]
    return table


def in_the_plane() -> dict[str, list | np.ndarray]:
    time = np.tile(0.1 * np.arange(20), 2)
    table: dict[str, list | np.ndarray] = {"t": time, "run": ["1"] * 20 + ["2"] * 20}
    table["what"] = ["approach"] * 20 + ["mirror"] * 20
    for i in range(4):
        table |= {f"x{i}": 0.2 * i + 0.01 * time, f"y{i}": 0.05 * np.sin(time + i)}
    for q in (0, 1):
        table |= {f"gx{q}": 0.6 * q + 0.01 * time, f"gy{q}": 0 * time, f"a{q}": 90 * time}
    return table


def test_markers_in_millimetres(tmp_path):
    table = in_space()
    table["m5y"][40] = np.nan
    log, repairs = import_csv(*written(tmp_path, table, PAIRS))
    validate(log)
    assert repairs == [] and log.keypoints.shape == (1, 200, 9, 3)
    expected = swinging().astype(np.float32)
    assert np.isnan(log.keypoints[0, 40, 4, 1])
    np.testing.assert_allclose(np.delete(log.keypoints[0], 40, 0), np.delete(expected, 40, 0), atol=1e-5)
    np.testing.assert_allclose(log.time[0], DT * np.arange(200), atol=1e-9)


def test_a_table_seen_from_above_with_measured_grippers(tmp_path):
    log, repairs = import_csv(*written(tmp_path, in_the_plane(), PLANAR))
    validate(log)
    assert repairs == [] and log.keypoints.shape == (2, 20, 4, 2)
    assert log.meta["motion"] == ["approach", "mirror"] and log.meta["take"] == ["1", "2"]
    assert log.meta["table"] == {"friction_coefficient": 0.1}
    assert log.meta["keypoint_arclength_m"] == [0.0, 0.2, 0.4, 0.6]
    np.testing.assert_allclose(log.gripper_pose[0, :, 1, 2], np.radians(90 * 0.1 * np.arange(20)), atol=1e-6)
    np.testing.assert_allclose(log.gripper_command[0, :-1, 0], np.tile([0.01, 0, np.pi / 2], (19, 1)), atol=1e-5)


def test_a_take_ends_where_the_motion_has_another_name(tmp_path):
    table = in_the_plane()
    table["run"] = ["1"] * 40
    table["t"] = 0.1 * np.arange(40)
    log, _ = import_csv(*written(tmp_path, table, PLANAR))
    assert log.meta["motion"] == ["approach", "mirror"] and log.episode_length.tolist() == [20, 20]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "mm"', 'unit = "m"', "measures 684.* 0.684 m if they are in mm"),
        ('unit = "mm"', 'unit = "ft"', "unit of length is 'ft'"),
        ('unit = "mm"', "", r"\[frame\] lacks unit, expected m, cm, mm or in"),
        ('unit = "mm"', 'unit = "mm"\nup = "y"', "state that z is up"),
        ('unit = "mm"', 'unit = "mm"\nup = "w"', "up is 'w'"),
        ("count = 9", "count = 10", "has no column 'm10x'"),
        ("count = 9", 'count = "9"', r"\[columns\] count is '9', expected how many"),
        ('"m{i}y"', '"m{i}x"', r"keypoint is \['m{i}x', 'm{i}x', 'm{i}z'\], expected another column for each"),
        ("count = 9", "count = 9\ngriper_0 = 3", "unknown fields .*griper_0"),
        ("count = 9", 'count = 9\ngripper_0 = ["a", "b", "c", "d", "e", "f", "g"]', "but not gripper_1"),
        ("count = 9", 'count = 9\ngripper_0 = ["a", "b", "c"]', "expected the 7 columns"),
        ('"m{i}x"', '"mx"', "with {i} in it"),
        ('time_unit = "ms"', 'time_unit = "min"', "time_unit is 'min'"),
        ("diameter_m = 0.006", "diameter_m = -1", "expected a number from 1e-06 to 1 m"),
        ("diameter_m = 0.006", "diameter_m = inf", "expected a number from 1e-06 to 1 m"),
        (
            'time_unit = "ms"',
            "",
            r"time between samples of episode 0 is 10\.0, expected .* \(in a layout: `time_unit`\)",
        ),
        ("diameter_m = 0.006", f"diameter_m = 0.006\nkeypoint_arclength_m = {list(range(9))}", "gives it 8 m: correct"),
        ("diameter_m = 0.006", f"diameter_m = {10**50}", "diameter_m is an integer of 167 bits"),
        ("count = 9", "count = 100000000", "count is 100000000, expected a whole number from 2 to 1000"),
        ("diameter_m = 0.006", "", r"\[cable\] lacks diameter_m"),
        ("diameter_m = 0.006", "diameter_m = 0.006\nkeypoint_arclength_m = [0, 1]", "expected 9 increasing numbers"),
        ("[cable]", "[cables]", "unknown tables .*cables"),
        ("[columns]", "[columns", "is no TOML"),
        ("[columns]", "[source]", r"lacks the table \[columns\]"),
    ],
)
def test_a_wrong_layout_is_reported(tmp_path, old, new, message):
    assert old in PAIRS
    path, layout = written(tmp_path, in_space(), PAIRS.replace(old, new))
    with pytest.raises(ValueError, match=message):
        import_csv(path, layout)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("m1x", "m1y", 1), "the column 'm1y' twice"),
        (lambda text: "\n".join(text.split("\n")[:2]), "has 2 rows"),
        (lambda text: re.sub(r"\n500010.0,[^,]*,", "\n500010.0,oops,", text), "line 3: column 'm1x' is 'oops'"),
        (lambda text: text.replace("\n500020.0,", "\n500020.0,7,"), "line 4: 29 cells, expected 28"),
        (lambda text: text.replace("\n500020.0,", "\n500000.0,"), r"line 4: the time is 500 s after 500\.01 s"),
        (lambda text: text.replace("\n500020.0,", "\n,"), "line 4: the time is empty"),
        (lambda text: text.replace("\n500010.0,", "\n\n\n5_00010.0,"), "line 5: column 't' is '5_00010.0'"),
        (lambda text: text.replace(",", ";"), "cells between semicolons, expected commas"),
        (lambda text: "# made in the lab\n" + text, "begins with a comment"),
    ],
    ids=["twice", "empty", "text", "cells", "time", "no time", "blank lines", "semicolons", "comment"],
)
def test_a_wrong_table_is_reported(tmp_path, change, message):
    path, layout = written(tmp_path, in_space(), PAIRS)
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=message):
        import_csv(path, layout)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: np.full_like(values, values[0]), "the same keypoints to the last digit"),
        (lambda values: values * np.linspace(1.0, 1.5, len(values)), "a cable does not stretch that much"),
        (lambda values: 1e30 * values, "largest entry of keypoints is .*, expected a number"),
    ],
    ids=["frozen", "stretched", "huge"],
)
def test_what_no_cable_does_is_refused(tmp_path, change, message):
    table = {name: values if name == "t" else change(values) for name, values in in_space().items()}
    with pytest.raises(ValueError, match=message):
        import_csv(*written(tmp_path, table, PAIRS))


def test_a_quaternion_in_the_wrong_columns_is_reported(tmp_path):
    table = in_space()
    pose = {f"g{q}{name}": np.zeros(200) for q in (0, 1) for name in ("x", "y", "z", "qw", "qx", "qy", "qz")}
    grippers = "".join(
        f"gripper_{q} = {[f'g{q}{name}' for name in ('x', 'y', 'z', 'qw', 'qx', 'qy', 'qz')]}\n" for q in (0, 1)
    )
    path, layout = written(tmp_path, table | pose, PAIRS + grippers)
    with pytest.raises(ValueError, match=r"run\.csv, line 2: the quaternion of a gripper has the length 0, expected 1"):
        import_csv(path, layout)


def test_the_quaternion_that_is_none_is_reported(tmp_path):
    table, names = in_space(), ("x", "y", "z", "qw", "qx", "qy", "qz")
    pose = {f"g{q}{name}": np.full(200, float(name == "qw")) for q in (0, 1) for name in names}
    pose["g1qw"][100] = 0.0
    grippers = "".join(f"gripper_{q} = {[f'g{q}{name}' for name in names]}\n" for q in (0, 1))
    with pytest.raises(ValueError, match="line 102: the quaternion of a gripper has the length 0, expected 1"):
        import_csv(*written(tmp_path, table | pose, PAIRS + grippers))


def test_keypoints_in_the_plane_lie_on_a_table(tmp_path):
    with pytest.raises(ValueError, match=r"layout\.toml: .*friction coefficient is missing"):
        import_csv(*written(tmp_path, in_the_plane(), PLANAR.replace("[table]\nfriction_coefficient = 0.1\n", "")))


def test_numbers_that_no_cable_has_are_those_of_the_layout(tmp_path):
    in_grams = PLANAR.replace("per_m = 0.08", "per_m = 80")
    with pytest.raises(ValueError, match=r"layout\.toml: .*no material exceeds"):
        import_csv(*written(tmp_path, in_the_plane(), in_grams))


def test_grippers_that_do_not_hold_the_cable_are_refused(tmp_path):
    table = in_the_plane()
    for column in ("gx0", "gx1"):
        table[column] = table[column] + 0.3
    with pytest.raises(ValueError, match=r"Keypoint 0 is 0.30 m from gripper 0.*in one frame"):
        import_csv(*written(tmp_path, table, PLANAR))


def test_missing_files_are_reported(tmp_path):
    path, layout = written(tmp_path, in_space(), PAIRS)
    with pytest.raises(ValueError, match=r"absent\.csv could not be read"):
        import_csv(tmp_path / "absent.csv", layout)
    with pytest.raises(ValueError, match=r"layout could not be read\. There is no file") as refused:
        import_csv(path, tmp_path / "absent.toml")
    smallest = str(refused.value).partition("[cable]")[2]
    table = {"t": DT * np.arange(200)}
    table |= {f"m{i}_{name}": 1000 * swinging()[:, i, k] for i in range(9) for k, name in enumerate("xyz")}
    log, _ = import_csv(*written(tmp_path, table, "[cable]" + smallest))
    assert log.keypoints.shape == (1, 200, 9, 3)


def test_the_example_in_the_documentation_works(tmp_path):
    layout = next(
        block for block in re.findall(r"```toml\n(.*?)```", DOCUMENTATION.read_text(), re.S) if "[columns]" in block
    )
    points = swinging(400)
    table: dict[str, list | np.ndarray] = {"t_ms": 1000 * DT * np.tile(np.arange(200), 2), "run": [1] * 200 + [2] * 200}
    table["motion"] = ["swing"] * 400
    for i in range(9):
        for k, name in enumerate("xyz"):
            table[f"m{i}_{name}"] = 1000 * points[:, i, k]
    log, _ = import_csv(*written(tmp_path, table, layout))
    assert log.meta["motion"] == ["swing", "swing"] and log.keypoints.shape == (2, 200, 9, 3)


def test_keypoints_that_the_layout_leaves_out_are_reported(tmp_path):
    table = in_space()
    _, repairs = import_csv(*written(tmp_path, table, PAIRS))
    assert not any("not read" in one for one in repairs)
    _, repairs = import_csv(*written(tmp_path, table, PAIRS.replace("count = 9", "count = 8")))
    assert repairs[0] == "Keypoint 9 has columns that were not read: the layout has first = 1, count = 8."


def above_the_table(height: float = 0.005) -> tuple[dict[str, list | np.ndarray], str]:
    """The table's csv as motion capture records it, with y up, and its layout."""
    table = in_the_plane()
    rng = np.random.default_rng(0)
    for i in range(4):
        # a right-handed frame with y up: its z is the table's x, its x the table's y
        table |= {f"z{i}": table.pop(f"x{i}"), f"x{i}": table.pop(f"y{i}"), f"y{i}": height * rng.uniform(-1, 1, 40)}
    for q in (0, 1):
        half = np.radians(table.pop(f"a{q}")) / 2
        table |= {f"gz{q}": table.pop(f"gx{q}"), f"gx{q}": table.pop(f"gy{q}"), f"gy{q}": np.full(40, 0.01)}
        # gripper's x axis along the cable: turned from z of that frame by the angle about its y
        turned = half - np.pi / 4
        table |= {f"qw{q}": np.cos(turned), f"qx{q}": 0 * half, f"qy{q}": np.sin(turned), f"qz{q}": 0 * half}
    layout = PLANAR.replace('["x{i}", "y{i}"]', '["x{i}", "y{i}", "z{i}"]').replace('angle_unit = "deg"\n', "")
    layout = layout.replace('unit = "m"', 'unit = "m"\nup = "y"')
    for q in (0, 1):
        names = ", ".join(f'"{name}{q}"' for name in ("gx", "gy", "gz", "qw", "qx", "qy", "qz"))
        layout = layout.replace(f'["gx{q}", "gy{q}", "a{q}"]', f"[{names}]")
    return table, layout


def test_heights_above_a_table_are_left_out(tmp_path):
    expected, _ = import_csv(*written(tmp_path, in_the_plane(), PLANAR))
    log, repairs = import_csv(*written(tmp_path, *above_the_table()))
    validate(log)
    assert repairs == ["The cable lies on a table: heights (99 % of them within 5.4 mm) were left out."]
    np.testing.assert_allclose(log.keypoints, expected.keypoints, atol=1e-6)
    np.testing.assert_allclose(log.gripper_pose, expected.gripper_pose, atol=1e-6)
    assert log.meta["table"] == {"friction_coefficient": 0.1}


def test_a_cable_that_does_not_lie_flat_is_not_on_a_table(tmp_path):
    with pytest.raises(ValueError, match=r"keypoints lie 54.* mm above or below the others, expected at most 20 mm"):
        import_csv(*written(tmp_path, *above_the_table(height=0.05)))
    table, layout = above_the_table()
    with pytest.raises(ValueError, match="Check which axis points up"):
        import_csv(*written(tmp_path, table, layout.replace('up = "y"', 'up = "z"')))
