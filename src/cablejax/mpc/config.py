"""Settings of the receding-horizon controller."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable
from typing import Any

from cablejax.adaptation.belief import AdaptationConfig
from cablejax.limits import check, check_workspace, require
from cablejax.mpc.plan import Solver
from cablejax.mpc.planners import LevenbergMarquardt
from cablejax.mpc.problem import ObjectiveConfig
from cablejax.residual.learner import LearnerConfig


@dataclasses.dataclass(frozen=True)
class MPCConfig:
    """Settings of the controller. The defaults are those of Wang et al., RA-L 2022, where it gives them.

    Attributes:
        horizon: h; a plan has h + 1 commands.
        history_length: samples H of the cable that the model looks back on: those of a loop's first history.
        cable_length: free length of the cable L [m].
        min_distance: least distance of the grippers, relative to L.
        max_distance: greatest distance of the grippers, relative to L: a taut cable cannot be shaped.
        workspace: lowest and highest corner (x, y) of where the grippers may be [m]; None = anywhere.
        max_change: greatest norm of the change of a gripper's motion from one step to the next [m], a bound on the
            acceleration. With it, holding still means braking, which may take several steps. None = any.
        radius: initial bound epsilon on one step's motion of each gripper [m]; adapted like a trust region.
        radius_min: smallest radius [m].
        radius_max: largest radius [m]: the model has not been trained on faster motions.
        grow_above: eta+; the radius grows if actual over predicted error reduction is at least this.
        shrink_below: eta-; the radius shrinks if the ratio is at most this.
        grow: tau+, factor by which the radius grows.
        shrink: tau-, factor by which the radius shrinks.
        min_reduction: smallest predicted change of the error that says anything about the model; below, the radius
            stays [m].
        hold_improvement: the grippers hold still if the plan lowers the error over the horizon, as a root mean square
            distance, by less than this compared with holding still [m].
        settle_after: commands without a lower error near the target after which the grippers rest.
        arrived: distance from the best pose [m] at which the grippers count as being there.
        wake: rise of the error at rest [m] that counts as a disturbance: planning begins again.
        restart_above: if the error stays above this [m], the cable is in another shape than the target's, and no plan
            of a few steps leads out: the controller straightens the cable, and shapes it from there.
        restart_after: commands without a lower error after which the error counts as staying; at once if no plan is
            better than holding still.
        max_restarts: most restarts; if the cable falls into the same shape repeatedly, the model is wrong.
        objective: weights and units of the planning problem.
        residual: settings of the online learner of the model's errors; None = the offline model alone.
        adaptation: settings of the online estimate of the cable, for a conditioned model; None = no estimate.
        solver: any `Solver`.
    """

    horizon: int = 5
    history_length: int = 6
    cable_length: float = 1.0
    min_distance: float = 0.15
    max_distance: float = 0.99
    workspace: tuple[tuple[float, float], tuple[float, float]] | None = None
    max_change: float | None = None
    radius: float = 0.05
    radius_min: float = 0.002
    radius_max: float = 0.05
    grow_above: float = 0.8
    shrink_below: float = 0.4
    grow: float = 1.05
    shrink: float = 0.95
    min_reduction: float = 1e-4
    hold_improvement: float = 2e-5
    settle_after: int = 8
    wake: float = 1e-3
    arrived: float = 1e-4
    restart_above: float = 0.05
    restart_after: int = 12
    max_restarts: int = 3
    objective: ObjectiveConfig = ObjectiveConfig()
    residual: LearnerConfig | None = LearnerConfig()
    adaptation: AdaptationConfig | None = None
    solver: Solver = LevenbergMarquardt()

    @classmethod
    def for_length(cls, length: float, **settings: Any) -> MPCConfig:
        """The defaults for a cable of this length [m]: every length among them is in proportion to it.

        The solver's tolerance, a fiftieth of a millimetre, is not.

        Args:
            length: free length of the cable [m].
            settings: fields that are to differ from these defaults, as they are: lengths in them are not scaled.

        Raises:
            ValueError: the length or a setting is out of its limits.
        """
        require(length, "length", "The cable's length")
        ratio = length / cls.cable_length
        own = (
            "cable_length",
            "radius",
            "radius_min",
            "radius_max",
            "min_reduction",
            "hold_improvement",
            "wake",
            "arrived",
            "restart_above",
        )
        scaled = {name: ratio * getattr(cls, name) for name in own}
        lengths = {name: ratio * getattr(cls.objective, name) for name in ("rotation_weight", "arrival_margin")}
        scaled["objective"] = dataclasses.replace(cls.objective, **lengths)
        interval = getattr(settings.get("objective"), "interval", cls.objective.interval)
        scaled["residual"] = cls.residual and cls.residual.scaled(ratio, interval)
        return cls(**{**scaled, **settings})

    def __post_init__(self):
        check(
            self,
            "horizon",
            history_length="history",
            cable_length="positive",
            radius_max="positive",
            grow="positive",
            min_reduction="positive",
            hold_improvement="not_negative",
            settle_after="count",
            wake="positive",
            arrived="positive",
            restart_above="positive",
            restart_after="count",
            max_restarts="count_from_zero",
        )
        if not 0 <= self.min_distance < self.max_distance <= 1:
            raise ValueError(
                f"MPCConfig distances {self.min_distance} to {self.max_distance}: expected 0 <= min_distance < "
                "max_distance <= 1, relative to the cable's length."
            )
        check_workspace(self)
        if self.max_change is not None:
            check(self, max_change="positive")
        if not 0 < self.radius_min <= self.radius <= self.radius_max:
            raise ValueError(
                f"MPCConfig radii {self.radius_min}, {self.radius}, {self.radius_max}: expected "
                "0 < radius_min <= radius <= radius_max."
            )
        if not (self.shrink_below < self.grow_above and 0 < self.shrink <= 1 <= self.grow):
            raise ValueError(
                f"MPCConfig radius: thresholds {self.shrink_below}, {self.grow_above} must increase, and factors "
                f"{self.shrink}, {self.grow} lie on either side of 1."
            )
        self._check_parts()

    def _check_parts(self) -> None:
        """Raises ValueError unless every part of the settings is of its kind."""
        for name, kind, optional in (
            ("objective", ObjectiveConfig, False),
            ("residual", LearnerConfig, True),
            ("adaptation", AdaptationConfig, True),
        ):
            value = getattr(self, name)
            if not (isinstance(value, kind) or (optional and value is None)):
                raise ValueError(
                    f"MPCConfig.{name} is {value!r}, expected {kind.__name__}{' or None' if optional else ''}."
                )
        if not (callable(self.solver) and isinstance(self.solver, Hashable)) or isinstance(self.solver, type):
            raise ValueError(
                f"MPCConfig.solver is {self.solver!r}, expected a solver such as LevenbergMarquardt(); `SOLVERS` has "
                "them by name."
            )

    @property
    def n_commands(self) -> int:
        """Commands of a plan, T = h + 1."""
        return self.horizon + 1
