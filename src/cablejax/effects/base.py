"""Effects of a cable: how they change its physics, and through which hook of a simulator."""

from __future__ import annotations

import abc
import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from cablejax.cable import Discretisation
from cablejax.effects.effect import Effect
from cablejax.effects.physics import Physics


@dataclasses.dataclass(frozen=True)
class Context:
    """Facts of a log before any effect is fitted, from which `Effect.starts` makes its guesses.

    Attributes:
        config: the nominal cable.
        keypoints: as the nominal simulator has them [m], shape [E, T, N, 2].
        residual: observed less nominal keypoints [m], NaN = not observed, shape [E, T, N, 2].
        duration: of the shortest episode [s].
        max_curvature: largest curvature of the nominal cable in each episode [1/m], shape [E].
    """

    config: Discretisation
    keypoints: Float[np.ndarray, "E T N 2"]
    residual: Float[np.ndarray, "E T N 2"]
    duration: float
    max_curvature: Float[np.ndarray, "E"]


Hook = Literal[
    "bending", "extension", "memory", "table", "mass", "grasp", "compliance", "input", "observation", "obstacle"
]
"""Points at which an effect acts on a simulation: the bending law along the cable, the change of its length, its memory
of bends, the forces of the table, mass, the grasp, its compliance, the arms' response to commands, the observation of
the cable, and obstacles. Every simulator states the hooks that it honours."""


class CableEffect(Effect, abc.ABC):
    """Something that a real cable does and the nominal simulator does not.

    To add one of your own, subclass this in a dozen lines and pass it to `diagnose(log, effects=(*LIBRARY, Mine()))`;
    `check_effect` says whether it behaves. Effects are stateless: the attributes of `Effect` are those of the class.
    """

    hook: ClassVar[Hook]
    """The hook through which the effect acts."""
    side: ClassVar[Literal["dynamics", "observation"]] = "dynamics"
    """Whether the cable moves differently, or is only seen differently."""
    symmetric: ClassVar[bool] = False
    """Whether a uniform straight cable with it still moves alike in a mirror, and counted from its other end."""
    stage: ClassVar[int] = 0
    """Effects of a later stage change what those of earlier ones have made, in whatever order they are given."""
    alone: ClassVar[bool] = False
    """Whether a simulation has one of them at a time: with a second one the first is not as it was stated."""

    def __init__(self):
        self.__post_init__()

    def around(self, place: Float[np.ndarray, "2"]) -> CableEffect:
        """The effect where the cable is about this place [m]: priors of places on the table move with it."""
        del place
        return self

    def besides(self, believed: Physics) -> CableEffect:
        """The effect of a cable that is believed to have this physics: without forms that make the same once more."""
        del believed
        return self

    def sized(self, length: float) -> CableEffect:
        """The effect on a cable of this length [m]: lengths and curvatures are sought in proportion to it.

        Priors and null values of parameters in m and 1/m are those of a cable of 1 m; so are their bounds, which only
        get wider.
        """
        factors = [{"m": length, "1/m": 1.0 / length}.get(p.unit, 1.0) for p in self.parameters]
        parameters = tuple(
            dataclasses.replace(
                p,
                low=min(p.low, factor * p.low),
                high=max(p.high, factor * p.high),
                centre=factor * p.centre,
                scale=p.scale if p.log else factor * p.scale,
            )
            for p, factor in zip(self.parameters, factors, strict=True)
        )
        null = tuple(factor * value for value, factor in zip(self.null, factors, strict=True))
        return self._with(parameters=parameters, null=null)

    def _with(self, **attributes: Any) -> CableEffect:
        other = copy.copy(self)
        vars(other).update(attributes)
        return other

    def seen_from(self, parameters: Mapping[str, float], place: Sequence[float]) -> dict[str, float]:
        """Parameters by the names of the verdict in a world whose origin is this place [m]."""
        del place
        return dict(parameters)

    @abc.abstractmethod
    def apply(self, physics: Physics, values: Sequence[Any], variant: int, config: Discretisation) -> Physics:
        """The physics with this effect. NumPy in, NumPy out; JAX in, JAX out, differentiable in `values`.

        Args:
            physics: of one cable, other effects included.
            values: of `parameters`, in their order and units.
            variant: one of `variants`.
            config: the nominal cable.
        """

    @abc.abstractmethod
    def starts(self, context: Context) -> Sequence[tuple[int, Sequence[float]]]:
        """Pairs (variant, values) from which fits begin; enough of them that one is within reach of the truth."""

    def reported(self, values: Sequence[float], variant: int, config: Discretisation) -> dict[str, tuple[Any, str]]:
        """Parameters by the names of the verdict, as (value, unit). Choices are integers."""
        named = {p.name: (float(v), p.unit) for p, v in zip(self.parameters, values, strict=True)}
        return named if self.variant_name is None else {self.variant_name: (variant, ""), **named}

    def given(self, parameters: Mapping[str, float], config: Discretisation) -> tuple[tuple[float, ...], int]:
        """Inverse of `reported`: `values` and `variant` of parameters by the names of the verdict.

        A parameter that is not given takes its prior median; so what a verdict leaves out does no harm.
        """
        named = {p.name: p.centre for p in self.parameters}
        own = self._from_reported(dict(parameters), config)
        variant = int(own.get("variant", own.get(self.variant_name or "", self.variants[0])))
        return tuple(float(own.get(name, centre)) for name, centre in named.items()), variant

    def _from_reported(self, parameters: dict[str, float], config: Discretisation) -> dict[str, float]:
        """`parameters` by the names and in the units of `self.parameters`; the variant as "variant" or its own name."""
        del config
        return parameters

    def location(self, values: Sequence[float], variant: int, config: Discretisation) -> dict[str, Any]:
        """The effect's place: keys "along_cable_m", "time_s", "table_m" of the verdict, where they apply."""
        del values, variant, config
        return {}


def section(centre: Any, width: Any, config: Discretisation) -> Any:
    """Share of each joint's stretch of cable within `[centre - width/2, centre + width/2]`, shape [J].

    Smooth in both: the edges are as wide as half a link.
    """
    xp = centre.__array_namespace__()
    s = (np.arange(config.n_joints) + 0.5).astype(np.float32) * config.link_length
    edge = 0.25 * config.link_length
    # bounded exponents: no overflow far from an edge
    begin = xp.clip((centre - 0.5 * width - s) / edge, -30.0, 30.0)
    end = xp.clip((s - centre - 0.5 * width) / edge, -30.0, 30.0)
    return 1.0 / ((1.0 + xp.exp(begin)) * (1.0 + xp.exp(end)))


def hat(centre: Any, config: Discretisation) -> Any:
    """Weights that split a point at arc length `centre` between its two neighbouring nodes, shape [n]."""
    xp = centre.__array_namespace__()
    nodes = np.arange(config.n_links).astype(np.float32)
    return xp.maximum(1.0 - xp.abs(nodes - centre / config.link_length), 0.0)
