"""Effects outside the specification, which a diagnosis should call unknown."""

from __future__ import annotations

import numpy as np

from .effects import EFFECTS, SPECIFIED, effect, on_arm, on_camera, on_world, sign, swept_place
from .motions import INTERVAL

if len(SPECIFIED) != 22:
    raise RuntimeError(f"The specification has 22 effects, this file found {len(SPECIFIED)}.")


@effect(
    "magnet", "world", (0.002, 8.0),
    lambda rng, c: {"place": swept_place(rng, c), "reach": rng.uniform(0.06, 0.14)},
)  # fmt: skip
def _(setup, fixed, x):
    (px, py), reach = fixed["place"], fixed["reach"]
    return on_world(setup, magnet=(px, py, x, reach)), {"x_m": px, "y_m": py, "pull_n_per_m": x, "reach_m": reach}


@effect("stiffness_drift", "world", (0.05, 2.3), lambda rng, c: {"sign": sign(rng), "time": rng.uniform(6.0, 15.0)})
def _(setup, fixed, x):
    drift = float(np.exp(fixed["sign"] * x) - 1.0)
    return on_world(setup, drift=drift, drift_time=fixed["time"]), {"relative": drift, "time_s": fixed["time"]}


@effect("anisotropic_friction", "world", (0.05, 3.0), lambda rng, c: {"sign": sign(rng, 0.7)}, ("translation",))
def _(setup, fixed, x):
    anisotropy = float(np.exp(fixed["sign"] * x) - 1.0)
    return on_world(setup, anisotropy=anisotropy), {"y_over_x": 1.0 + anisotropy}


def _tether(rng, context):
    s = float(rng.uniform(0.3, 0.7))
    start = np.mean([m.points[0, round(s * (m.points.shape[1] - 1))] for m in context.motions], axis=0)
    place = start + rng.uniform(-0.03, 0.03, 2)
    return {"centre": s * context.world.length, "place": place.tolist(), "slack": rng.uniform(0.01, 0.05)}


@effect("tether", "world", (0.03, 100.0), _tether)
def _(setup, fixed, x):
    return on_world(setup, tether=(fixed["centre"], *fixed["place"], x, fixed["slack"])), {
        "centre_m": fixed["centre"], "x_m": fixed["place"][0], "y_m": fixed["place"][1], "stiffness_n_per_m": x,
        "slack_m": fixed["slack"],
    }  # fmt: skip


@effect(
    "table_vibration", "world", (0.0005, 0.06),
    lambda rng, c: {"frequency": rng.uniform(0.7, 2.5), "direction": rng.uniform(-np.pi, np.pi)},
)  # fmt: skip
def _(setup, fixed, x):
    return on_world(setup, shake=(x, fixed["frequency"], fixed["direction"])), {
        "amplitude_m": x, "frequency_hz": fixed["frequency"], "direction_rad": fixed["direction"],
    }  # fmt: skip


@effect(
    "viscoelastic_creep", "world", (0.05, 30.0), lambda rng, c: {"time": rng.uniform(3.0, 8.0)}, ("overload_return",)
)
def _(setup, fixed, x):
    return on_world(setup, creep=x, creep_time=fixed["time"]), {"ratio": x, "time_s": fixed["time"]}


@effect("barrel_distortion", "camera", (0.002, 3.0), lambda rng, c: {"sign": sign(rng, 0.3)})
def _(setup, fixed, x):
    return on_camera(setup, barrel=fixed["sign"] * x), {"per_m2": fixed["sign"] * x}


def _bursts(rng, context):
    rows = []
    for episode, commands in enumerate(context.commands):
        for _ in range(int(rng.integers(3, 7))):
            samples, k, angle = int(rng.integers(4, 18)), int(rng.integers(1, 12)), rng.uniform(-np.pi, np.pi)
            first = int(rng.integers(0, len(commands.twist) - samples))
            rows.append((episode, first, samples, k, float(np.cos(angle)), float(np.sin(angle))))
    return {"rows": rows}


@effect("tracking_bursts", "camera", (0.002, 0.4), _bursts)
def _(setup, fixed, x):
    rows = tuple((*row[:4], x * row[4], x * row[5]) for row in fixed["rows"])
    return on_camera(setup, outliers=rows), {"jump_m": x, "bursts": len(rows), "mean_s": INTERVAL * 10.5}


@effect("rotation_backlash", "arm", (0.004, 0.8), lambda rng, c: {}, ("overload_return", "ramp_hold"))
def _(setup, fixed, x):
    return on_arm(setup, play=x), {"half_width_rad": x}


@effect("lubricated_friction", "world", (0.05, 5.0), lambda rng, c: {}, ("translation", "translation"))
def _(setup, fixed, x):
    speed = float(0.1 * np.exp(-x))
    return on_world(setup, lubrication=speed), {"doubling_speed_m_per_s": speed}


@effect("signed_stiffness", "world", (0.02, 0.95), lambda rng, c: {"sign": sign(rng)})
def _(setup, fixed, x):
    return on_world(setup, signed_stiffness=fixed["sign"] * x), {"relative": fixed["sign"] * x}


@effect("camera_drift", "camera", (0.0005, 0.2), lambda rng, c: {"direction": rng.uniform(-np.pi, np.pi)})
def _(setup, fixed, x):
    wander = (float(x * np.cos(fixed["direction"])), float(x * np.sin(fixed["direction"])))
    return on_camera(setup, wander=wander), {"x_m": wander[0], "y_m": wander[1]}


UNSPECIFIED = tuple(name for name in EFFECTS if name not in SPECIFIED)
