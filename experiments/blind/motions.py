"""Motions of the grippers: the named motions of a log, commands at 10 Hz with holds.

Every motion starts at rest with a gentle arch to the left of the line from gripper 0 to gripper 1; `mirror_` motions
are reflected about that line. Distances are in lengths of the cable.
"""

from __future__ import annotations

import dataclasses

import numpy as np

FAMILIES = ("approach_u", "approach_s", "approach_z", "translation", "ramp_hold", "overload_return", "taut")
INTERVAL = 0.1
"""Time between samples of a log [s]."""
SETTLING = 1.5
"""Time at rest after which a sample counts as a hold [s]."""
FASTEST, FASTEST_TURN = 0.06, 0.33
"""Largest commanded speeds [m/s, rad/s]."""


@dataclasses.dataclass(frozen=True)
class Commands:
    """Commands of the grippers in one episode.

    Attributes:
        motion: its name.
        start: (x, y, theta) of both grippers [m, rad], shape [2, 3].
        twist: held from every sample to the next, shape [T, 2, 3]; the last one is zero.
        hold: shape [T].
    """

    motion: str
    start: np.ndarray
    twist: np.ndarray
    hold: np.ndarray

    @property
    def path(self) -> np.ndarray:
        """Commanded poses at every sample, shape [T, 2, 3]."""
        moved = INTERVAL * np.cumsum(self.twist[:-1], axis=0)
        return np.concatenate([self.start[None], self.start + moved])

    def fine_path(self, frames: int) -> np.ndarray:
        """Commanded poses `frames` times per sample, shape [(T - 1) * frames + 1, 2, 3]."""
        path = self.path
        at = np.arange((len(path) - 1) * frames + 1) / frames
        index = np.minimum(at.astype(int), len(path) - 2)
        share = (at - index)[:, None, None]
        return (1 - share) * path[index] + share * path[index + 1]


def draw_motions(rng: np.random.Generator, length: float, wanted: tuple[str, ...] = ()) -> list[Commands]:
    """Six episodes: the wanted families, mostly one motion with its mirror image, and a variety of others."""
    names: list[str] = []
    for name in wanted:
        names.append(("mirror_" if rng.random() < 0.5 else "") + name)
    if rng.random() < 0.85:
        family = str(rng.choice(["approach_u", "approach_s", "approach_z", "ramp_hold", "translation"]))
        names += [family, "mirror_" + family]
    if "overload_return" not in wanted and rng.random() < 0.8:
        names.append(("mirror_" if rng.random() < 0.2 else "") + "overload_return")
    while len(names) < 6:
        family = str(rng.choice(FAMILIES, p=[0.2, 0.13, 0.13, 0.2, 0.19, 0.05, 0.1]))
        name = ("mirror_" if rng.random() < 0.4 else "") + family
        if names.count(name) < 2:
            names.append(name)
    return [draw_motion(rng, name, length) for name in rng.permutation(names[:6]).tolist()]


def draw_motion(rng: np.random.Generator, name: str, length: float) -> Commands:
    """One episode of 20 to 30 s."""
    for _ in range(200):
        commands = _try_motion(rng, name, length)
        if commands is not None:
            return commands
    raise RuntimeError(f"No motion {name!r} within the limits was found.")


def _try_motion(rng: np.random.Generator, name: str, length: float) -> Commands | None:
    mirror = name.startswith("mirror_")
    family = name.removeprefix("mirror_")
    draw = rng.uniform
    # Configurations (distance, angle 0, angle 1, shift of both x and y, lateral offset of gripper 1) in the upright
    # frame, and the seconds each move takes.
    d0, a0, a1 = draw(0.80, 0.965), draw(0.1, 0.45), -draw(0.1, 0.45)
    start = (d0, a0, a1, 0.0, 0.0, 0.0)
    late = draw(5.0, 10.0)
    if family == "approach_u":
        end = (
            draw(0.63, 0.745),
            draw(0.55, 1.0),
            -draw(0.55, 1.0),
            draw(-0.05, 0.05),
            draw(-0.03, 0.03),
            draw(-0.03, 0.03),
        )
        over = (end[0] - draw(0.01, 0.15), end[1] + draw(0.0, 0.5), end[2] - draw(0.0, 0.5), *end[3:])
        way = [(over, draw(5.5, 9.5)), (end, draw(2.0, 5.0))]
    elif family == "approach_s":
        end = (
            draw(0.70, 0.77),
            draw(0.4, 0.7),
            draw(-0.02, 0.12),
            draw(-0.05, 0.05),
            draw(-0.03, 0.03),
            draw(-0.02, 0.04),
        )
        over = (end[0] - draw(0.02, 0.08), end[1] + draw(0.05, 0.3), end[2] + draw(-0.05, 0.12), *end[3:])
        way = [(over, draw(5.5, 9.0)), (end, draw(2.0, 5.0))]
    elif family == "approach_z":
        end = (
            draw(0.72, 0.83),
            draw(0.15, 0.5),
            draw(-0.45, 0.05),
            draw(-0.05, 0.05),
            draw(-0.03, 0.03),
            draw(-0.08, 0.08),
        )
        over = (end[0] - draw(0.04, 0.09), end[1] + draw(-0.05, 0.2), end[2] + draw(-0.15, 0.1), *end[3:])
        way = [(over, draw(5.5, 9.5)), (end, draw(2.0, 5.0))]
    elif family == "translation":
        start = (draw(0.75, 0.88), 0.5 + draw(-0.06, 0.06), -0.5 + draw(-0.06, 0.06), 0.0, 0.0, 0.0)
        far, angle = draw(0.1, 0.24), rng.choice([-1, 1]) * np.pi / 2 + draw(-0.5, 0.5)
        back = draw(-0.3, 0.7)
        there = (*start[:3], far * np.cos(angle), far * np.sin(angle), 0.0)
        turned = angle + draw(-0.3, 0.3)
        end = (*start[:3], back * far * np.cos(turned), back * far * np.sin(turned), 0.0)
        way = [(there, draw(4.5, 7.5)), (end, draw(4.0, 9.0))]
    elif family == "ramp_hold":
        up = draw(0.5, 0.95)
        there = (draw(0.56, 0.68), a0 + up, a1 - up * draw(0.8, 1.2), draw(-0.02, 0.02), draw(-0.02, 0.02), 0.0)
        way = [(there, draw(8.0, 12.0)), (start, draw(3.0, 5.0))]
        late = draw(2.0, 4.0)
    elif family == "overload_return":
        up = draw(1.25, 1.6)
        there = (draw(0.32, 0.40), a0 + up, a1 - up * draw(0.92, 1.08), 0.0, 0.0, 0.0)
        way = [(there, draw(8.5, 10.5)), (start, draw(8.5, 10.5))]
        late = draw(0.4, 1.5)
    elif family == "taut":
        start = (min(d0, 0.95), *start[1:])
        there = (draw(0.975, 0.988), draw(-0.03, 0.08), draw(-0.08, 0.03), 0.0, 0.0, draw(-0.01, 0.01))
        end = (draw(0.84, 0.91), draw(0.12, 0.4), -draw(0.12, 0.4), draw(-0.04, 0.04), draw(-0.05, 0.05), 0.0)
        way = [(there, draw(4.5, 7.0)), (end, draw(3.0, 6.0))]
    else:
        raise ValueError(f"Unknown motion {name!r}, expected one of {FAMILIES}, with or without 'mirror_'.")
    # Pause between the two moves: short mostly, a hold of 3 to 5 s now and then.
    pause = (
        late
        if family in ("ramp_hold", "overload_return")
        else (draw(3.0, 5.0) if rng.random() < 0.3 else draw(0.4, 1.2))
    )
    centre, tilt = np.array([0.45 * length, 0.0]) + draw(-0.03, 0.03, 2), draw(-0.05, 0.05)

    def pose(configuration: tuple[float, ...]) -> np.ndarray:
        d, t0, t1, x, y, lateral = configuration
        rows = np.array([[-d / 2, 0.0, t0], [d / 2, lateral, t1]]) * [length, length, 1.0]
        rows[:, :2] += np.array([x, y]) * length
        if mirror:
            rows[:, 1:] *= -1
        c, s = np.cos(tilt), np.sin(tilt)
        rows[:, :2] = rows[:, :2] @ np.array([[c, s], [-s, c]]) + centre
        rows[:, 2] += tilt
        return rows

    initial, final = draw(2.1, 3.1), draw(3.0, 5.0)
    pieces: list[tuple[int, np.ndarray]] = [(round(initial / INTERVAL), np.zeros((2, 3)))]
    here = first = pose(start)
    for index, (configuration, seconds) in enumerate(way):
        steps = round(seconds / INTERVAL)
        goal = pose(configuration)
        twist = (goal - here) / (steps * INTERVAL)
        if np.hypot(*twist[:, :2].T).max() > FASTEST or np.abs(twist[:, 2]).max() > FASTEST_TURN:
            return None
        pieces.append((steps, twist))
        here = goal
        if index == 0:
            pieces.append((round(pause / INTERVAL), np.zeros((2, 3))))
    total = sum(steps for steps, _ in pieces) * INTERVAL
    pieces.append((round(max(final, 20.0 - total) / INTERVAL) + 1, np.zeros((2, 3))))
    twist = np.concatenate([np.repeat(piece[None], steps, axis=0) for steps, piece in pieces])
    if not 20.0 <= len(twist) * INTERVAL <= 30.2:
        return None
    commands = Commands(name, first, twist, _holds(twist))
    reach = np.linalg.norm(commands.path[:, 1, :2] - commands.path[:, 0, :2], axis=1).max()
    return commands if reach <= 0.99 * length else None


def _holds(twist: np.ndarray) -> np.ndarray:
    """Samples at which both grippers have been at rest for `SETTLING`, and from the start on until they first move."""
    at_rest = np.concatenate([[True], (twist[:-1] == 0).all(axis=(1, 2))])
    hold = np.zeros(len(twist), bool)
    since = np.inf
    for index, rest in enumerate(at_rest):
        since = since + INTERVAL if rest else 0.0
        hold[index] = rest and since >= SETTLING
    return hold
