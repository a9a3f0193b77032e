"""ROS 2 bags and MCAP files, written here by the library that reads them."""

import itertools
import re
import sys
from pathlib import Path

import numpy as np
import pytest

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'cablejax[recordings]'")

from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

from cablejax import limits  # noqa: E402
from cablejax.gaplog import validate  # noqa: E402
from cablejax.poses import poses_from_markers, rotated  # noqa: E402
from cablejax.recordings.bags import import_mcap  # noqa: E402
from recording_cases import DT, swinging  # noqa: E402

DOCUMENTATION = Path(__file__).parents[1] / "docs" / "how_to" / "own_recording.md"
STORE = get_typestore(Stores.ROS2_HUMBLE)
POINT = STORE.types["geometry_msgs/msg/Point"]
QUATERNION = STORE.types["geometry_msgs/msg/Quaternion"]
POSE = STORE.types["geometry_msgs/msg/Pose"]
ARRAY = STORE.types["geometry_msgs/msg/PoseArray"]
STAMPED = STORE.types["geometry_msgs/msg/PoseStamped"]
HEADER = STORE.types["std_msgs/msg/Header"]
TIME = STORE.types["builtin_interfaces/msg/Time"]

LAYOUT = """
[cable]
diameter_m = 0.006
linear_density_kg_per_m = 0.04
bending_stiffness_n_m2 = 6e-4
[frame]
unit = "m"
[topics]
keypoints = "/cable/keypoints"
grippers = ["/left/pose", "/right/pose"]
"""


def header(time: float, frame: str = "world"):
    return HEADER(TIME(int(time), round(1e9 * (time % 1))), frame)


def pose_of(values: np.ndarray):
    x, y, z, w, i, j, k = map(float, values)
    return POSE(POINT(x, y, z), QUATERNION(i, j, k, w))


def write_bag(path: Path, points: np.ndarray, grippers: dict[str, tuple[np.ndarray, np.ndarray]], storage) -> Path:
    """Keypoints every 10 ms, and each gripper's poses at times of its own."""
    with Writer(path, version=9, storage_plugin=storage) as bag:
        connection = bag.add_connection("/cable/keypoints", ARRAY.__msgtype__, typestore=STORE)
        for t, frame in enumerate(points):
            time = 1000.0 + DT * t
            message = ARRAY(header(time), [pose_of(np.append(p, [1.0, 0, 0, 0])) for p in frame])
            bag.write(connection, round(1e9 * time), STORE.serialize_cdr(message, ARRAY.__msgtype__))
        for topic, (times, poses) in grippers.items():
            connection = bag.add_connection(topic, STAMPED.__msgtype__, typestore=STORE)
            for time, values in zip(1000.0 + times, poses, strict=True):
                message = STAMPED(header(time), pose_of(values))
                # Written in any order and with the recorder's own delay: the stamps in the headers count.
                bag.write(connection, round(1e9 * (time + 0.2)), STORE.serialize_cdr(message, STAMPED.__msgtype__))
    return path


def grippers_of(points: np.ndarray, stride: int = 2) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Poses of both grippers at every other sample; every third quaternion with the other sign."""
    times = DT * np.arange(len(points))[::stride]
    result = {}
    for topic, (a, b) in {"/left/pose": (0, 1), "/right/pose": (7, 8)}.items():
        pose = poses_from_markers(points[:, a], points[:, b], points[:, a if a == 0 else b])[::stride]
        pose[::3, 3:] *= -1
        result[topic] = times, pose
    return result


def layout(folder: Path, text: str = LAYOUT) -> Path:
    (folder / "layout.toml").write_text(text)
    return folder / "layout.toml"


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_is_read_with_both_kinds_of_storage(tmp_path, storage):
    points = swinging(201)
    points[30, 4] = np.nan
    bag = write_bag(tmp_path / "bag", points, grippers_of(points), storage)
    log, repairs = import_mcap(bag, layout(tmp_path))
    validate(log)
    assert repairs == [] and log.keypoints.shape == (1, 201, 9, 3)
    np.testing.assert_allclose(log.keypoints[0], points, atol=1e-6)
    np.testing.assert_allclose(log.time[0], DT * np.arange(201), atol=1e-6)
    np.testing.assert_allclose(log.gripper_pose[0, ::2, 0, :3], points[::2, 0], atol=1e-5)
    x = np.tile([1.0, 0, 0], (201, 1))
    for q, (a, b) in enumerate(((0, 1), (7, 8))):
        along = points[:, b] - points[:, a]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        own = rotated(log.gripper_pose[0, :, q, 3:].astype(float), x)
        assert np.degrees(np.arccos(np.clip((own * along).sum(axis=1), -1, 1))).max() < 4  # noise of 0.3 mm on 30
    assert abs(np.diff(log.gripper_pose[0, :, :, 3:], axis=0)).max() < 0.05


def test_a_single_mcap_file_is_read_like_its_bag(tmp_path):
    points = swinging()
    bag = write_bag(tmp_path / "bag", points, {}, StoragePlugin.MCAP)
    file = next(bag.glob("*.mcap"))
    text = LAYOUT.replace('grippers = ["/left/pose", "/right/pose"]', "")
    log, repairs = import_mcap(file, layout(tmp_path, text))
    assert repairs == []
    np.testing.assert_allclose(log.gripper_pose[0, :, 1, :3], points[:, 8], atol=1e-6)


def test_a_pose_that_was_misread_is_put_right_before_it_is_interpolated(tmp_path):
    """Between slow poses it would be away for many samples of the keypoints."""
    points = swinging(201)
    grippers = grippers_of(points, stride=4)
    right = {topic: (times, poses.copy()) for topic, (times, poses) in grippers.items()}
    grippers["/right/pose"][1][8, :3] += [0.5, 0.0, 0.0]
    logs = []
    for name, poses in (("wrong", grippers), ("right", right)):
        bag = write_bag(tmp_path / name, points, poses, StoragePlugin.MCAP)
        logs.append(import_mcap(bag, layout(tmp_path)))
    (log, repairs), (expected, none) = logs
    assert none == [] and len(repairs) == 1
    assert repairs[0].startswith("/right/pose jumps away and back in 1 of 51 samples, for example by 0.5")
    np.testing.assert_allclose(log.gripper_pose[..., :3], expected.gripper_pose[..., :3], atol=0.02)


def test_clocks_that_do_not_overlap_are_named(tmp_path):
    points = swinging(201)
    grippers = {topic: (times + 500.0, poses) for topic, (times, poses) in grippers_of(points).items()}
    bag = write_bag(tmp_path / "bag", points, grippers, StoragePlugin.MCAP)
    told = r"/left/pose has time stamps from 1500\.000 to 1502\.000 s and .* from 1000\.000 .* do not overlap"
    with pytest.raises(ValueError, match=told):
        import_mcap(bag, layout(tmp_path))


def test_poses_too_rare_to_say_how_a_gripper_moves_are_named(tmp_path):
    points = swinging(201)
    bag = write_bag(tmp_path / "bag", points, grippers_of(points, stride=10), StoragePlugin.MCAP)
    with pytest.raises(ValueError, match=r"poses on /left/pose are 0\.1 s apart, expected 0\.075 s at most"):
        import_mcap(bag, layout(tmp_path))


def test_headers_that_name_other_frames_are_told(tmp_path, monkeypatch):
    points, frames = swinging(201), itertools.cycle(["world", "", "camera"])
    monkeypatch.setattr(sys.modules[__name__], "header", lambda time, original=header: original(time, next(frames)))
    bag = write_bag(tmp_path / "bag", points, grippers_of(points), StoragePlugin.MCAP)
    _, (told,) = import_mcap(bag, layout(tmp_path))
    assert told == "The headers name the frames camera, world: all positions are assumed to be in one frame."


def test_headers_without_a_time_are_named(tmp_path):
    points = swinging(201)
    grippers = grippers_of(points)
    grippers["/right/pose"] = np.zeros(101), grippers["/right/pose"][1]
    bag = write_bag(tmp_path / "bag", points, grippers, StoragePlugin.MCAP)
    with pytest.raises(ValueError, match=r"all messages on /right/pose are stamped 1000 s, .* set header\.stamp"):
        import_mcap(bag, layout(tmp_path))


def test_a_gap_in_a_gripper_cuts_the_recording(tmp_path):
    points = swinging(201)
    grippers = grippers_of(points)
    times, poses = grippers["/left/pose"]
    keep = (times < 0.795) | (times > 1.095)
    grippers["/left/pose"] = times[keep], poses[keep]
    log, repairs = import_mcap(write_bag(tmp_path / "bag", points, grippers, StoragePlugin.MCAP), layout(tmp_path))
    assert log.episode_length.tolist() == [79, 91] and "one of the gripper poses is missing" in repairs[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("/cable/keypoints", "/cable", r"has no topic /cable; it has /cable/keypoints \(geometry_msgs/msg/PoseArray\)"),
        ("/right/pose", "/cable/keypoints", "PoseArray, expected geometry_msgs/msg/PoseStamped"),
        ('["/left/pose", "/right/pose"]', '["/left/pose"]', "expected the topics of gripper 0 and gripper 1"),
        ('unit = "m"', 'unit = "mm"', "expected 0.05 to 20"),
        ('unit = "m"', 'unit = "m"\nup = "x"', "state that z is up"),
        ("[topics]", '[topics]\nclock = "/clock"', "unknown fields .*clock"),
    ],
)
def test_a_wrong_layout_is_reported(tmp_path, old, new, message):
    points = swinging(60)
    bag = write_bag(tmp_path / "bag", points, grippers_of(points), StoragePlugin.MCAP)
    with pytest.raises(ValueError, match=message):
        import_mcap(bag, layout(tmp_path, LAYOUT.replace(old, new)))


def test_positions_of_a_left_handed_frame_beside_quaternions_of_another_are_reported(tmp_path):
    points = swinging(201)
    grippers = grippers_of(points)
    mirrored = {topic: (times, poses * [1, -1, 1, 1, 1, 1, 1]) for topic, (times, poses) in grippers.items()}
    bag = write_bag(tmp_path / "bag", points * [1, -1, 1], mirrored, StoragePlugin.MCAP)
    with pytest.raises(ValueError, match="positions are mirrored along y"):
        import_mcap(bag, layout(tmp_path))


def test_messages_that_change_their_size_are_reported(tmp_path):
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/cable/keypoints", ARRAY.__msgtype__, typestore=STORE)
        for t, count in enumerate((9, 9, 8)):
            message = ARRAY(header(float(t)), [pose_of(np.eye(7)[3])] * count)
            bag.write(connection, 10**9 * t, STORE.serialize_cdr(message, ARRAY.__msgtype__))
    text = LAYOUT.replace('grippers = ["/left/pose", "/right/pose"]', "")
    with pytest.raises(
        ValueError, match="message 2 on /cable/keypoints, has 8 poses, and the first 9, expected the same"
    ):
        import_mcap(tmp_path / "bag", layout(tmp_path, text))


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (np.arange(60)[::-1], r"message 1 on /cable/keypoints: the time is 1000\.58 s after 1000\.59 s"),
        (
            np.arange(60).reshape(2, 30).T.ravel(),
            r"message 2 on /cable/keypoints: the time is 1000\.01 s after 1000\.3 s",
        ),
        (np.repeat(np.arange(30), 2), r"message 1 on /cable/keypoints: the time is 1000 s after 1000 s"),
    ],
    ids=["reversed", "two halves", "twice"],
)
@pytest.mark.parametrize("topic", ["/cable/keypoints", "/left/pose"])
def test_times_that_run_backwards_are_refused(tmp_path, monkeypatch, order, message, topic):
    """Sorted, they would show a motion that never was."""
    points, stamps = swinging(60), np.tile(np.arange(60), (3, 1))
    stamps[["/cable/keypoints", "/left/pose"].index(topic)] = order
    times = iter((1000.0 + DT * stamps).ravel())
    monkeypatch.setattr(sys.modules[__name__], "header", lambda time, original=header: original(next(times)))
    bag = write_bag(tmp_path / "bag", points, grippers_of(points, stride=1), StoragePlugin.MCAP)
    with pytest.raises(ValueError, match=message.replace("/cable/keypoints", topic) + ", expected increasing times"):
        import_mcap(bag, layout(tmp_path))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_that_was_cut_off_can_be_mended(tmp_path, storage):
    bag = write_bag(tmp_path / "bag", swinging(60), {}, storage)
    file = next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(
        ValueError, match=r"bag could not be read as a bag: .* If it was cut off, copy it again, or mend"
    ):
        import_mcap(bag, layout(tmp_path))


def test_a_quaternion_that_is_none_is_reported_with_its_message(tmp_path):
    points = swinging(60)
    grippers = grippers_of(points)
    grippers["/right/pose"][1][7, 3:] = 0.0
    bag = write_bag(tmp_path / "bag", points, grippers, StoragePlugin.MCAP)
    with pytest.raises(
        ValueError, match=r"bag, message 7 on /right/pose: the quaternion of a gripper has the length 0"
    ):
        import_mcap(bag, layout(tmp_path))


def test_a_missing_layout_is_answered_with_the_smallest_which_works(tmp_path):
    bag = write_bag(tmp_path / "bag", 1000 * swinging(60), {}, StoragePlugin.MCAP)
    with pytest.raises(ValueError, match="There is no file") as refused:
        import_mcap(bag, tmp_path / "layout.toml")
    text = str(refused.value)
    log, _ = import_mcap(bag, layout(tmp_path, text[text.index("[cable]") :]))
    assert log.keypoints.shape == (1, 60, 9, 3)


def test_a_bag_that_is_too_large_is_refused_before_it_is_read(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", swinging(60), {}, StoragePlugin.MCAP)
    text = LAYOUT.replace('grippers = ["/left/pose", "/right/pose"]', "")
    file = next(bag.glob("*.mcap"))
    whole = file.stat().st_size
    for name, high, message in (
        ("bag_bytes", whole - 1, "The size of .*bag.* is .*, expected a whole number from 0 to"),
        ("array_bytes", 5_000, "The size of the messages on /cable/keypoints is .* from 0 to 5000 bytes"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(limits, "LIMITS", {**limits.LIMITS, name: limits.Limit(0, high, "bytes", whole=True)})
            for path in (bag, file):
                with pytest.raises(ValueError, match=message):
                    import_mcap(path, layout(tmp_path, text))
    assert import_mcap(bag, layout(tmp_path, text))[1] == []


def test_what_is_no_bag_is_reported(tmp_path):
    """Before its layout is asked for, where the file alone shows it."""
    (tmp_path / "run.mcap").write_bytes(b"nothing")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "run.txt").write_bytes(b"nothing")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("run.mcap", "is no MCAP file: it begins with b'nothing', expected a bag"),
        ("empty.mcap", "is empty, expected a bag"),
        ("folder", "is empty, expected a bag"),
        ("absent", "does not exist, expected a bag"),
    ):
        with pytest.raises(ValueError, match=message):
            import_mcap(tmp_path / name, tmp_path / "no layout.toml")
    for name in ("cut.mcap", "run.txt"):
        with pytest.raises(ValueError, match="could not be read as a bag"):
            import_mcap(tmp_path / name, layout(tmp_path))


def test_without_the_library_its_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ValueError, match=r"pip install 'cablejax\[recordings\]'"):
        import_mcap(tmp_path, layout(tmp_path))


def test_the_example_in_the_documentation_works(tmp_path):
    text = next(
        block for block in re.findall(r"```toml\n(.*?)```", DOCUMENTATION.read_text(), re.S) if "[topics]" in block
    )
    points = swinging(120)
    bag = write_bag(tmp_path / "bag", points, grippers_of(points), StoragePlugin.MCAP)
    log, _ = import_mcap(bag, layout(tmp_path, text))
    assert log.keypoints.shape == (1, 119, 9, 3)  # the last sample is after the last pose of a gripper


@pytest.mark.parametrize("stride", [6, 7])
def test_poses_at_any_rate_that_is_accepted_are_known_between_their_stamps(tmp_path, stride):
    points = swinging(201)
    bag = write_bag(tmp_path / "bag", points, grippers_of(points, stride=stride), StoragePlugin.MCAP)
    log, _ = import_mcap(bag, layout(tmp_path))
    last = 200 // stride * stride
    assert log.episode_length.tolist()[0] in range(last - 1, last + 3) and len(log.episode_length) == 1
