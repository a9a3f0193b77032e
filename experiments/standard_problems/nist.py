"""Nonlinear regression from NIST's Statistical Reference Datasets, in boxes.

Data, starts and certified values are those of https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml, in the public
domain. The certified sum of squares, eleven digits of it, comes out of data and certified parameters only if all of
them are typed right, and the tests check that it does. Two of the names are problems of More, Garbow and Hillstrom as
well: MGH09 is Kowalik and Osborne's, MGH10 Meyer's, and MGH17 is Osborne's first.

NIST sets no bounds. Every data set is taken twice: in a box around start and certified values, which is not active at
the optimum, and in the same box with an upper bound on one parameter below its certified value, which is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from standard_problems.base import BoundedProblem


@dataclasses.dataclass(frozen=True, eq=False)
class DataSet:
    """One of NIST's.

    Attributes:
        name: NIST's.
        model: `(parameters, x) -> y`.
        x: predictor, shape [M].
        y: response, shape [M].
        starts: NIST's two, the second nearer.
        certified: parameters, eleven digits, shape [P].
        sum_of_squares: certified residual sum of squares, eleven digits.
        cut: index of the parameter that the active bound is on.
        cut_optimum: best half sum of squares known with `certified[cut]` bounded by `CUT` times its value.
    """

    name: str
    model: Callable[[Array, Array], Array]
    x: Float[np.ndarray, " M"]
    y: Float[np.ndarray, " M"]
    starts: tuple[tuple[float, ...], tuple[float, ...]]
    certified: tuple[float, ...]
    sum_of_squares: float
    cut: int
    cut_optimum: float

    def residuals(self, b: Float[Array, " P"]) -> Float[Array, " M"]:
        """Model minus response."""
        return self.model(b, jnp.asarray(self.x)) - jnp.asarray(self.y)


CUT = 0.9
"""The active bound, relative to the certified value of its parameter."""
WIDTH = 3.0
"""The box reaches from the origin's side of start and certified value, divided by this, to this times the farther."""


def nist_problems() -> list[BoundedProblem]:
    """Every data set from both of NIST's starts in the wide box, and from the nearer one with a bound active."""
    problems = []
    for data in DATA_SETS:
        certified = np.array(data.certified)
        lower, upper = _box(data)
        common = {"family": "NIST", "residuals": data.residuals}
        for which, start in enumerate(data.starts, 1):
            problems.append(
                BoundedProblem(
                    f"{data.name}, start {which}",
                    start=np.array(start),
                    optimum=0.5 * data.sum_of_squares,
                    lower=lower,
                    upper=upper,
                    note="certified by NIST",
                    **common,
                )
            )
        cut_lower, cut_upper = lower.copy(), upper.copy()
        bound = cut_upper if certified[data.cut] > 0 else cut_lower
        bound[data.cut] = CUT * certified[data.cut]
        problems.append(
            BoundedProblem(
                f"{data.name}, b{data.cut + 1} cut",
                start=np.clip(np.array(data.starts[1]), cut_lower, cut_upper),
                optimum=data.cut_optimum,
                lower=cut_lower,
                upper=cut_upper,
                note="best of many starts",
                **common,
            )
        )
    return problems


def _box(data: DataSet) -> tuple[np.ndarray, np.ndarray]:
    points = np.array([*data.starts, data.certified])
    size, sign = np.abs(points), np.sign(data.certified)
    near, far = size.min(axis=0) / WIDTH, size.max(axis=0) * WIDTH
    return np.where(sign > 0, near, -far), np.where(sign > 0, far, -near)


def _saturation(b, x):
    return b[0] * (1.0 - jnp.exp(-b[1] * x))


def _power(b, x):
    return b[0] * x ** b[1]


def _logistic(b, x):
    return b[0] / (1.0 + jnp.exp(b[1] - b[2] * x))


def _richards(b, x):
    return b[0] / (1.0 + jnp.exp(b[1] - b[2] * x)) ** (1.0 / b[3])


def _peak(b, x):
    return b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2)


def _kowalik_osborne(b, x):
    return b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3])


def _meyer(b, x):
    return b[0] * jnp.exp(b[1] / (x + b[2]))


def _osborne(b, x):
    return b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4])


def _cubic_ratio(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1.0 + b[4] * x + b[5] * x**2 + b[6] * x**3)


# fmt: off
DATA_SETS = (
    DataSet(
        "Misra1a", _saturation,
        np.array([77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0]),
        np.array([10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]),
        starts=((500.0, 1e-4), (250.0, 5e-4)), certified=(2.3894212918e2, 5.5015643181e-4),
        sum_of_squares=1.2455138894e-1, cut=0, cut_optimum=0.574014738296,
    ),
    DataSet(
        "DanWood", _power,
        np.array([1.309, 1.471, 1.490, 1.565, 1.611, 1.680]), np.array([2.138, 3.421, 3.597, 4.340, 4.882, 5.660]),
        starts=((1.0, 5.0), (0.7, 4.0)), certified=(7.6886226176e-1, 3.8604055871),
        sum_of_squares=4.3173084083e-3, cut=1, cut_optimum=0.0332737369759,
    ),
    DataSet(
        "BoxBOD", _saturation,
        np.array([1.0, 2.0, 3.0, 5.0, 7.0, 10.0]), np.array([109.0, 149.0, 149.0, 191.0, 213.0, 224.0]),
        starts=((1.0, 1.0), (100.0, 0.75)), certified=(2.1380940889e2, 5.4723748542e-1),
        sum_of_squares=1.1680088766e3, cut=0, cut_optimum=1028.34181305,
    ),
    DataSet(
        "Rat42", _logistic,
        np.array([9.0, 14.0, 21.0, 28.0, 42.0, 57.0, 63.0, 70.0, 79.0]),
        np.array([8.930, 10.800, 18.590, 22.330, 39.350, 56.110, 61.730, 64.620, 67.080]),
        starts=((100.0, 1.0, 0.1), (75.0, 2.5, 0.07)), certified=(7.2462237576e1, 2.6180768402, 6.7359200066e-2),
        sum_of_squares=8.0565229338, cut=1, cut_optimum=11.0019196499,
    ),
    DataSet(
        "Rat43", _richards,
        np.arange(1.0, 16.0),
        np.array([16.08, 33.83, 65.80, 97.20, 191.55, 326.20, 386.87, 520.53, 590.03, 651.92, 724.93, 699.56, 689.96,
                  637.56, 717.41]),
        starts=((100.0, 10.0, 1.0, 1.0), (700.0, 5.0, 0.75, 1.3)),
        certified=(6.9964151270e2, 5.2771253025, 7.5962938329e-1, 1.2792483859),
        sum_of_squares=8.7864049080e3, cut=2, cut_optimum=4466.36054614,
    ),
    DataSet(
        "Eckerle4", _peak,
        np.array([400.0, 405.0, 410.0, 415.0, 420.0, 425.0, 430.0, 435.0, 436.5, 438.0, 439.5, 441.0, 442.5, 444.0,
                  445.5, 447.0, 448.5, 450.0, 451.5, 453.0, 454.5, 456.0, 457.5, 459.0, 460.5, 462.0, 463.5, 465.0,
                  470.0, 475.0, 480.0, 485.0, 490.0, 495.0, 500.0]),
        np.array([0.0001575, 0.0001699, 0.0002350, 0.0003102, 0.0004917, 0.0008710, 0.0017418, 0.0046400, 0.0065895,
                  0.0097302, 0.0149002, 0.0237310, 0.0401683, 0.0712559, 0.1264458, 0.2073413, 0.2902366, 0.3445623,
                  0.3698049, 0.3668534, 0.3106727, 0.2078154, 0.1164354, 0.0616764, 0.0337200, 0.0194023, 0.0117831,
                  0.0074357, 0.0022732, 0.0008800, 0.0004579, 0.0002345, 0.0001586, 0.0001143, 0.0000710]),
        starts=((1.0, 10.0, 500.0), (1.5, 5.0, 450.0)), certified=(1.5543827178, 4.0888321754, 4.5154121844e2),
        sum_of_squares=1.4635887487e-3, cut=1, cut_optimum=0.00261990783451,
    ),
    DataSet(
        "MGH09", _kowalik_osborne,
        np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625]),
        np.array([0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246]),
        starts=((25.0, 39.0, 41.5, 39.0), (0.25, 0.39, 0.415, 0.39)),
        certified=(1.9280693458e-1, 1.9128232873e-1, 1.2305650693e-1, 1.3606233068e-1),
        sum_of_squares=3.0750560385e-4, cut=0, cut_optimum=0.000218437634521,
    ),
    DataSet(
        "MGH10", _meyer,
        np.arange(50.0, 126.0, 5.0),
        np.array([34780.0, 28610.0, 23650.0, 19630.0, 16370.0, 13720.0, 11540.0, 9744.0, 8261.0, 7030.0, 6005.0,
                  5147.0, 4427.0, 3820.0, 3307.0, 2872.0]),
        starts=((2.0, 4e5, 2.5e4), (0.02, 4e3, 250.0)),
        certified=(5.6096364710e-3, 6.1813463463e3, 3.4522363462e2),
        sum_of_squares=8.7945855171e1, cut=1, cut_optimum=2825.58968257,
    ),
    DataSet(
        "MGH17", _osborne,
        np.arange(0.0, 321.0, 10.0),
        np.array([0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751, 0.718, 0.685, 0.658,
                  0.628, 0.603, 0.580, 0.558, 0.538, 0.522, 0.506, 0.490, 0.478, 0.467, 0.457, 0.448, 0.438, 0.431,
                  0.424, 0.420, 0.414, 0.411, 0.406]),
        starts=((50.0, 150.0, -100.0, 1.0, 2.0), (0.5, 1.5, -1.0, 0.01, 0.02)),
        certified=(3.7541005211e-1, 1.9358469127, -1.4646871366, 1.2867534640e-2, 2.2122699662e-2),
        sum_of_squares=5.4648946975e-5, cut=1, cut_optimum=2.84190405274e-05,
    ),
    DataSet(
        "Thurber", _cubic_ratio,
        np.array([-3.067, -2.981, -2.921, -2.912, -2.840, -2.797, -2.702, -2.699, -2.633, -2.481, -2.363, -2.322,
                  -1.501, -1.460, -1.274, -1.212, -1.100, -1.046, -0.915, -0.714, -0.566, -0.545, -0.400, -0.309,
                  -0.109, -0.103, 0.010, 0.119, 0.377, 0.790, 0.963, 1.006, 1.115, 1.572, 1.841, 2.047, 2.200]),
        np.array([80.574, 84.248, 87.264, 87.195, 89.076, 89.608, 89.868, 90.101, 92.405, 95.854, 100.696, 101.060,
                  401.672, 390.724, 567.534, 635.316, 733.054, 759.087, 894.206, 990.785, 1090.109, 1080.914,
                  1122.643, 1178.351, 1260.531, 1273.514, 1288.339, 1327.543, 1353.863, 1414.509, 1425.208, 1421.384,
                  1442.962, 1464.350, 1468.705, 1447.894, 1457.628]),
        starts=((1000.0, 1000.0, 400.0, 40.0, 0.7, 0.3, 0.03), (1300.0, 1500.0, 500.0, 75.0, 1.0, 0.4, 0.05)),
        certified=(1.2881396800e3, 1.4910792535e3, 5.8323836877e2, 7.5416644291e1, 9.6629502864e-1, 3.9797285797e-1,
                   4.9727297349e-2),
        sum_of_squares=5.6427082397e3, cut=4, cut_optimum=3275.05270222,
    ),
)
# fmt: on
