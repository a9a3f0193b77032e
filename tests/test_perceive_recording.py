"""Recorded cloud sequences: what is read, and what is refused."""

import numpy as np
import pytest

from cablejax.perceive.recording import POSES_HEADER, CloudSequence, read_clouds

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (7, 3)).astype(np.float32)
POSES = np.arange(18.0).reshape(3, 2, 3)
TIME = np.array([0.0, 0.1, 0.2])


def sequence() -> CloudSequence:
    return CloudSequence(TIME, [POINTS[:4], POINTS[:0], POINTS[4:]], POSES)


def same(found: CloudSequence, clouds) -> None:
    np.testing.assert_allclose(found.time, TIME)
    np.testing.assert_allclose(found.gripper_pose, POSES)
    for cloud, expected in zip(found.clouds, clouds, strict=True):
        np.testing.assert_allclose(cloud, expected, atol=1e-6)


def test_clouds_by_their_counts_are_read(tmp_path):
    np.savez(tmp_path / "clouds.npz", time=TIME, gripper_pose=POSES, points=POINTS, count=np.array([4, 0, 3]))
    same(read_clouds(tmp_path / "clouds.npz"), sequence().clouds)


def test_padded_clouds_are_read(tmp_path):
    points = np.full((3, 5, 3), np.nan, np.float32)
    points[0, 1:5], points[2, :3] = POINTS[:4], POINTS[4:]
    np.savez(tmp_path / "padded.npz", time=TIME, gripper_pose=POSES, points=points)
    same(read_clouds(tmp_path / "padded.npz"), sequence().clouds)


def pcd(points: np.ndarray, encoding: str, *, cut: int = 0, fields: str = "rgb x y z") -> bytes:
    """A PCD file with a colour before the position."""
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4 4\nTYPE U F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA {encoding}\n"
    )
    if encoding == "ascii":
        body = "".join(f"4278190080 {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points).encode()
    else:
        table = np.zeros(len(points), [("rgb", "<u4"), ("xyz", "<f4", 3)])
        table["xyz"] = points
        body = table.tobytes()
    return header.encode() + body[: len(body) - cut]


def folder(path, encoding="binary", *, rows=3, **options):
    for index, cloud in enumerate(sequence().clouds):
        (path / f"{index:04d}.pcd").write_bytes(pcd(cloud, encoding, **options))
    table = np.concatenate([TIME[:, None], POSES.reshape(3, 6)], axis=1)[:rows]
    lines = [",".join(POSES_HEADER), *(",".join(f"{value:.9g}" for value in row) for row in table)]
    (path / "poses.csv").write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_folder_of_pcd_files_is_read(tmp_path, encoding):
    same(read_clouds(folder(tmp_path, encoding)), sequence().clouds)


def test_files_are_ordered_by_their_numbers(tmp_path):
    sequence_folder = folder(tmp_path)
    for index, file in enumerate(sorted(tmp_path.glob("*.pcd"))):
        file.rename(tmp_path / f"cloud_{9 + index}.pcd")
    same(read_clouds(sequence_folder), sequence().clouds)


def test_missing_measurements_stay_missing(tmp_path):
    folder(tmp_path)
    (tmp_path / "0000.pcd").write_bytes(pcd(np.full((2, 3), np.nan, np.float32), "ascii"))
    assert np.isnan(read_clouds(tmp_path).clouds[0]).all()


def short(poses):
    """Replaces the second row by two numbers."""
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join([*lines[:2], "0.5,1.0", *lines[3:]]))


def edit(file, old, new):
    file.write_bytes(file.read_bytes().replace(old, new, 1))


def broken(path, what):
    if what == "no file":
        return path / "absent.npz"
    if what == "empty folder":
        return path
    if what == "pickle":
        np.save(path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
        return (path / "a.npy").rename(path / "a.npz")
    if what == "objects":
        np.savez(path / "a.npz", time=TIME, gripper_pose=POSES, points=np.array([[1], [1, 2]], dtype=object))
        return path / "a.npz"
    if what == "text":
        (path / "a.npz").write_text("time")
        return path / "a.npz"
    if what in ("lacks", "shape", "count", "negative", "words", "infinite", "order", "pose"):
        arrays = {"time": TIME, "gripper_pose": POSES, "points": np.zeros((3, 5, 3))}
        if what == "lacks":
            del arrays["gripper_pose"]
        if what == "shape":
            arrays["points"] = np.zeros((3, 5))
        if what == "count":
            arrays |= {"points": np.zeros((7, 3)), "count": np.array([4, 0, 2])}
        if what == "negative":
            arrays |= {"points": np.zeros((7, 3)), "count": np.array([9, -4, 2])}
        if what == "words":
            arrays |= {"points": np.zeros((7, 3)), "count": np.array(["4", "0", "3"])}
        if what == "infinite":
            arrays["points"] += np.inf
        if what == "order":
            arrays["time"] = TIME[::-1]
        if what == "pose":
            arrays["gripper_pose"] = POSES * np.nan
        np.savez(path / "a.npz", **arrays)
        return path / "a.npz"
    return {
        "few rows": lambda: folder(path, rows=2),
        "another file": lambda: (folder(path), path / "poses.csv")[1],
        "short row": lambda: (folder(path), short(path / "poses.csv"))[0],
        "compressed": lambda: folder(path, "binary_compressed"),
        "cut": lambda: folder(path, cut=3),
        "cut text": lambda: folder(path, "ascii", cut=40),
        "points": lambda: (folder(path), edit(path / "0000.pcd", b"POINTS 4", b"POINTS -1"))[0],
        "no values": lambda: (folder(path), edit(path / "0000.pcd", b"COUNT 1", b"COUNT 0"))[0],
        "inner folder": lambda: (folder(path), (path / "a.pcd").mkdir())[0],
        "no z": lambda: folder(path, fields="rgb x y w"),
        "no data": lambda: (folder(path), (path / "0000.pcd").write_text("VERSION 0.7\n"), path)[-1],
    }[what]()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("no file", "does not exist"),
        ("another file", "another kind of file, expected an .npz"),
        ("short row", "a row '0.5,1.0', expected 7 numbers"),
        ("empty folder", "0 PCD files"),
        ("pickle", "no .npz archive"),
        ("objects", "holds Python objects"),
        ("text", "no .npz archive"),
        ("lacks", "lacks gripper_pose"),
        ("shape", "points has shape"),
        ("count", "sums up to 6"),
        ("negative", "whole numbers >= 0"),
        ("words", "under count, expected an array of real numbers"),
        ("infinite", "nothing to see"),
        ("points", "contradicts itself: -1 points"),
        ("no values", "contradicts itself: 4 points of 0 values"),
        ("inner folder", "expected 4 rows|is a folder"),
        ("order", "increasing"),
        ("pose", "frame 0 is not finite"),
        ("few rows", "expected 3 rows"),
        ("compressed", "expected ascii or binary"),
        ("cut", "cut short"),
        ("cut text", "cut short"),
        ("no z", "expected x, y and z"),
        ("no data", "not a PCD file"),
    ],
)
def test_broken_recordings_are_refused(tmp_path, what, message):
    with pytest.raises(ValueError, match=message):
        read_clouds(broken(tmp_path, what))
