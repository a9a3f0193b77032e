"""Bounded least squares that are nobody's learned model: from Moré, Garbow, Hillstrom 1981 (as in CUTEst), and NIST's
StRD nonlinear regression (https://www.itl.nist.gov/div898/strd), with bounds added where the source has none."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np


@dataclasses.dataclass(frozen=True)
class Problem:
    """Minimise half the sum of squared residuals between bounds.

    Attributes:
        residuals: of y [P], shape [M].
        lower: least y, shape [P].
        upper: greatest y, shape [P].
        start: first guess, shape [P]; may be outside.
        value: the known minimum, where the source gives it for these bounds.
        other_minima: whether local solvers may end in different ones.
    """

    residuals: Callable
    lower: list[float]
    upper: list[float]
    start: list[float]
    value: float | None = None
    other_minima: bool = False


INF = float("inf")
FREE2, FREE3, FREE4 = [INF] * 2, [INF] * 3, [INF] * 4


def _minus(bounds):
    return [-b for b in bounds]


def rosenbrock(y):
    return jnp.stack([10.0 * (y[1] - y[0] ** 2), 1.0 - y[0]])


def beale(y):
    return jnp.stack([c - y[0] * (1.0 - y[1] ** k) for k, c in ((1, 1.5), (2, 2.25), (3, 2.625))])


def powell_singular(y):
    return jnp.stack(
        [
            y[0] + 10.0 * y[1],
            5.0**0.5 * (y[2] - y[3]),
            (y[1] - 2.0 * y[2]) ** 2,
            10.0**0.5 * (y[0] - y[3]) ** 2,
        ]
    )


def wood(y):
    return jnp.stack(
        [
            10.0 * (y[1] - y[0] ** 2),
            1.0 - y[0],
            90.0**0.5 * (y[3] - y[2] ** 2),
            1.0 - y[2],
            10.0**0.5 * (y[1] + y[3] - 2.0),
            10.0**-0.5 * (y[1] - y[3]),
        ]
    )


def helical_valley(y):
    turn = jnp.arctan2(y[1], y[0]) / (2 * jnp.pi)
    return jnp.stack([10.0 * (y[2] - 10.0 * turn), 10.0 * (jnp.hypot(y[0], y[1]) - 1.0), y[2]])


def brown_badly_scaled(y):
    return jnp.stack([y[0] - 1e6, y[1] - 2e-6, y[0] * y[1] - 2.0])


def freudenstein_roth(y):
    return jnp.stack(
        [-13.0 + y[0] + ((5.0 - y[1]) * y[1] - 2.0) * y[1], -29.0 + y[0] + ((y[1] + 1.0) * y[1] - 14.0) * y[1]]
    )


MISRA1A = np.array(
    [
        [10.07, 77.6], [14.73, 114.9], [17.94, 141.1], [23.93, 190.8], [29.61, 239.9], [35.18, 289.0], [40.02, 332.8],
        [44.82, 378.4], [50.76, 434.8], [55.05, 477.3], [61.01, 536.8], [66.40, 593.1], [75.47, 689.1], [81.78, 760.0],
    ]
)  # fmt: skip
BOX_BOD = np.array([[109, 1], [149, 2], [149, 3], [191, 5], [213, 7], [224, 10]], float)
MGH09 = np.array(
    [
        [0.1957, 4.0], [0.1947, 2.0], [0.1735, 1.0], [0.16, 0.5], [0.0844, 0.25], [0.0627, 0.167], [0.0456, 0.125],
        [0.0342, 0.1], [0.0323, 0.0833], [0.0235, 0.0714], [0.0246, 0.0625],
    ]
)  # fmt: skip


def misra1a(y):
    return y[0] * (1.0 - jnp.exp(-y[1] * MISRA1A[:, 1])) - MISRA1A[:, 0]


def box_bod(y):
    return y[0] * (1.0 - jnp.exp(-y[1] * BOX_BOD[:, 1])) - BOX_BOD[:, 0]


def mgh09(y):
    x = MGH09[:, 1]
    return y[0] * (x**2 + x * y[1]) / (x**2 + x * y[2] + y[3]) - MGH09[:, 0]


PROBLEMS = {
    "Rosenbrock": Problem(rosenbrock, _minus(FREE2), FREE2, [-1.2, 1.0], 0.0),
    "Rosenbrock, corner": Problem(rosenbrock, [-1.5, -1.5], [0.8, 1.5], [-1.2, 1.0], 0.02),
    "Rosenbrock, start outside": Problem(rosenbrock, [1.5, -3.0], [4.0, 3.0], [-1.2, 1.0], 0.125 + 0.0),
    "Beale in a box": Problem(beale, [0.6, 0.5], [10.0, 100.0], [1.0, 1.0]),
    "Powell singular": Problem(powell_singular, _minus(FREE4), FREE4, [3.0, -1.0, 0.0, 1.0], 0.0),
    "Powell singular in a box": Problem(
        powell_singular, [0.1, -20.0, -1.0, -1.0], [100.0, 20.0, 1.0, 50.0], [3.0, -1.0, 0.0, 1.0]
    ),
    "Wood in a box": Problem(wood, [-100.0] * 4, [0.0, 10.0, 100.0, 100.0], [-3.0, -1.0, -3.0, -1.0]),
    "helical valley in a box": Problem(helical_valley, [-100.0, -1.0, -1.0], [0.8, 1.0, 1.0], [-1.0, 0.0, 0.0]),
    "Brown badly scaled in a box": Problem(brown_badly_scaled, [0.0, 3e-5], [1e6, 100.0], [1.0, 1.0], 0.5 * 784.0),
    "Freudenstein and Roth in a box": Problem(
        freudenstein_roth, [0.5, -2.0], [20.0, 20.0], [0.5, -2.0], other_minima=True
    ),
    "Misra1a": Problem(misra1a, _minus(FREE2), FREE2, [500.0, 1e-4], 0.5 * 1.2455138894e-1),
    "Misra1a, bounded": Problem(misra1a, [0.0, 6e-4], [230.0, 1.0], [200.0, 7e-4]),
    "BoxBOD": Problem(box_bod, [0.0, 0.0], [1e4, 10.0], [100.0, 0.75], 0.5 * 1.1680088766e3),
    "MGH09": Problem(mgh09, [0.0] * 4, [10.0] * 4, [0.25, 0.39, 0.415, 0.39], 0.5 * 3.0750560385e-4),
    "MGH09, bounded": Problem(mgh09, [0.0] * 4, [0.18, 10.0, 10.0, 10.0], [0.25, 0.39, 0.415, 0.39]),
}  # fmt: skip
