"""Runs tests and the same motions on every corner of the versions that the package supports, and writes one page.

    python benchmarks/versions.py --out docs/results/versions.md tests/test_simulate_engines.py ...

`make matrix` names the tests. Each corner is an environment of its own in build/versions/, made by uv, which has to be
on the path or in the environment of this Python. Results are kept there: `--only 3 4` runs two corners, and the page
has the others as they were last, each with its commit.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import shutil
import subprocess
import sys
import xml.etree.ElementTree

ROOT = pathlib.Path(__file__).parents[1]
BUILD = ROOT / "build" / "versions"
MUJOCO = "mujoco>=3.17,<4", "mujoco>=4,<5"
# JAX 0.11 and newer need Python 3.12.
CORNERS = tuple(
    (python, mujoco, jax)
    for python, jax in (("3.11", "jax>=0.10,<0.11"), ("3.13", "jax>=0.10,<0.11"), ("3.13", "jax>=0.12,<0.13"))
    for mujoco in MUJOCO
)
SHOWN = "mujoco", "mujoco-mjx", "jax"
PLANTS = {
    "contact plant": (),
    "compliant grasp": ("gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.3",),
    "axial stretch": ("axial_stretch:stiffness_n=20",),
    "obstacle": ("obstacle:x_m=0,y_m=0.4,radius_m=0.03",),
    "hysteresis": ("bending_hysteresis:moment_n_m=0.02,transition_curvature_per_m=0.5",),
}


def motions() -> dict[str, list]:
    """Keypoints [m] after three seconds in each simulator built on MuJoCo."""
    import numpy as np

    from cablejax.cable import Cable, Discretisation
    from cablejax.effects.given import parse_effect
    from cablejax.effects.physics import nominal_physics
    from cablejax.simulate import MjxEngine, ThreadedEngine
    from cablejax.simulate.plant import Plant, PlantConfig

    ends = np.array([[-0.35, 0.0, 0.9], [0.35, 0.0, -0.9]])
    twist = np.array([[0.03, 0.02, -0.2], [-0.03, 0.03, 0.3]])
    lifted = [np.cos(0.45), 0.0, -np.sin(0.45), 0.0], [np.cos(0.45), 0.0, np.sin(0.45), 0.0]
    spatial_ends = np.array([[-0.4, 0.0, 0.0, *lifted[0]], [0.4, 0.0, 0.0, *lifted[1]]])
    spatial_twist = np.array([[0.03, 0.02, 0.01, 0.1, 0.0, 0.2], [-0.03, -0.01, 0.02, -0.1, 0.1, 0.1]])
    spatial = Discretisation(Cable(bending_stiffness=0.05), n_links=25, dimension=3, timestep=0.01)
    found = {}
    for name, engine in (("C MuJoCo", ThreadedEngine), ("MJX", MjxEngine)):
        for config, pose, velocity in ((Discretisation(), ends, twist), (spatial, spatial_ends, spatial_twist)):
            simulator = engine(config)
            start = simulator.initial_state(pose)
            _, seen = simulator.rollout(nominal_physics(config), start, np.repeat(velocity[None], 3, axis=0))
            found[f"{name}, {'plane' if config.dimension == 2 else 'space'}"] = seen.keypoints[-1]
    for name, effects in PLANTS.items():
        plant = Plant(PlantConfig(effects=tuple(map(parse_effect, effects))))
        plant.reset(ends)
        found[name] = plant.step(twist, 3.0).keypoints
    return {name: np.asarray(keypoints).tolist() for name, keypoints in found.items()}


def record(out: pathlib.Path) -> None:
    """Writes the versions of this environment, and what its simulators compute."""
    import importlib.metadata

    shown = {package: importlib.metadata.version(package) for package in SHOWN}
    out.write_text(json.dumps({"versions": shown, "motions": motions()}), encoding="utf-8")


def results_of(corner: tuple[str, str, str]) -> pathlib.Path:
    """Where the results of a corner are kept, in its environment."""
    return BUILD / "-".join(part.split(",")[0].replace(">=", "") for part in corner) / "results"


def run_corner(corner: tuple[str, str, str], tests: list[str], workers: int) -> None:
    """Makes an environment, runs the tests and the motions in it, and keeps versions, counts and keypoints."""
    python, *packages = corner
    results = results_of(corner)
    folder, inside = results.parent, str(results.parent / "bin" / "python")
    uv = shutil.which(
        "uv", path=os.pathsep.join((os.environ.get("PATH", ""), str(pathlib.Path(sys.executable).parent)))
    )
    if uv is None:
        sys.exit("versions: uv is not on the path; install it with `python -m pip install uv`")
    subprocess.run([uv, "venv", "--quiet", "--allow-existing", "--python", python, str(folder)], check=True)
    install = [uv, "pip", "install", "--quiet", "--python", inside, "-e", f"{ROOT}[dev]", *packages]
    subprocess.run(install, check=True)
    results.mkdir(exist_ok=True)
    # These environments' own packages, not those of a checkout that the caller has on the path.
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    report = results / "tests.xml"
    parallel = ["-n", str(workers), "--dist", "loadfile"] if workers else ["-n", "0"]
    words = [inside, "-m", "pytest", "-q", "-m", "not slow", *parallel, f"--junitxml={report}", *tests]
    report.unlink(missing_ok=True)  # of an earlier run
    tested = subprocess.run(words, cwd=ROOT, env=own).returncode
    if not report.is_file():
        raise SystemExit(f"{python}: pytest ended with code {tested} before it tested anything.")
    subprocess.run([inside, __file__, "--record", str(results / "motions.json")], cwd=ROOT, env=own, check=True)
    suite = next(xml.etree.ElementTree.parse(report).getroot().iter("testsuite"))
    counts: dict = {name: int(suite.get(name, 0)) for name in ("tests", "skipped", "failures", "errors")}
    written = json.loads((results / "motions.json").read_text(encoding="utf-8"))
    broken = [case for case in suite.iter("testcase") if {"failure", "error"} & {entry.tag for entry in case}]
    counts["broken"] = [f"{case.get('classname')}.{case.get('name')}" for case in broken]
    describe = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    commit = subprocess.run(describe, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
    summary = {"python": python, "commit": commit, **counts, **written}
    (results / "corner.json").write_text(json.dumps(summary), encoding="utf-8")


def furthest(one: list, other: list) -> float:
    """Largest distance between two lists of keypoints [m]."""
    return max(sum((a - b) ** 2 for a, b in zip(p, q, strict=True)) ** 0.5 for p, q in zip(one, other, strict=True))


def page(corners: list[dict], tests: list[str]) -> str:
    """The page: what was tested, and how far the simulators are from the first corner's."""
    first, *others = (corner["motions"] for corner in corners)
    failed = [corner["failures"] + corner["errors"] for corner in corners]
    labels = [f"{c['python']} / {c['versions']['mujoco']} / {c['versions']['jax']}" for c in corners]
    lines = [
        "# Versions",
        "",
        "Made by `make matrix`. Every corner is an environment of its own with the newest other packages that "
        "`pyproject.toml` allows. JAX 0.11 and newer need Python 3.12. MuJoCo 4 has no MJX of its own version; the "
        "newest MJX accepts it.",
        "",
        f"{len(corners)} of {len(CORNERS)} corners have been run.",
        "",
        f"## Tests of {len(tests)} files",
        "",
        "| Python | MuJoCo | MJX | JAX | passed | skipped | failed | commit |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
        *(
            f"| {c['python']} | {' | '.join(c['versions'][name] for name in SHOWN)} | "
            f"{c['tests'] - c['skipped'] - bad} | {c['skipped']} | {bad} | {c['commit']} |"
            for c, bad in zip(corners, failed, strict=True)
        ),
        "",
        *(f"Failed on {label}: `{name}`.\n" for label, c in zip(labels, corners, strict=True) for name in c["broken"]),
        "Skipped on MuJoCo 4: comparisons with MuJoCo 3's `<composite>` and its cable plugin, which MuJoCo 4 removed.",
        "",
        "## The same motion of three seconds",
        "",
        f"Largest distance of a keypoint at the end from that of {labels[0]} [m]; columns are Python / MuJoCo / JAX. "
        "From the contact plant on: C MuJoCo with 40 links and contacts. MJX computes in single precision.",
        "",
        f"| simulator | {' | '.join(labels[1:])} |",
        f"|{' --- |' * len(corners)}",
        *(
            f"| {name} | {' | '.join(f'{furthest(keypoints, other[name]):.1e}' for other in others)} |"
            for name, keypoints in first.items()
        ),
    ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", help="files for pytest")
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "docs" / "results" / "versions.md")
    parser.add_argument("--workers", type=int, default=2, help="processes of pytest")
    numbers = range(1, len(CORNERS) + 1)
    parser.add_argument("--only", nargs="+", type=int, choices=numbers, default=numbers, help="corners to run")
    parser.add_argument("--record", type=pathlib.Path, help="only compute the motions here and write them to this file")
    options = parser.parse_args(arguments)
    if options.record is not None:
        return record(options.record)
    if not options.tests:
        parser.error("name the files that pytest runs")
    for number in options.only:
        run_corner(CORNERS[number - 1], options.tests, options.workers)
    kept = [results_of(corner) / "corner.json" for corner in CORNERS]
    corners = [json.loads(path.read_text(encoding="utf-8")) for path in kept if path.exists()]
    options.out.write_text(page(corners, options.tests), encoding="utf-8")
    print(f"Written to {options.out}", file=sys.stderr)
    if any(corner["failures"] + corner["errors"] for corner in corners):
        sys.exit("versions: tests failed")


if __name__ == "__main__":
    main()
