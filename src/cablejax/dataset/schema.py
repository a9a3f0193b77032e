"""Schema of a data set: its configuration, its arrays, and their JSON form."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from collections import Counter
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from cablejax.cable import Cable, Discretisation
from cablejax.effects import OUTSIDE
from cablejax.effects.given import EFFECTS, GivenEffect, with_effects
from cablejax.effects.physics import nominal_physics
from cablejax.limits import LIMITS, check, shown
from cablejax.simulate import ENGINES, ChainEngine, check_effects
from cablejax.simulate.equilibrium import FEWEST_LINKS
from cablejax.simulate.motions import MotionConfig

SCHEMA = "cablejax-dataset/2"
"""Name and version of the store's layout. Version 1 is read too, see `config_of_version_1`."""

PARAMETERS = ("stiffness_ratio", "friction_coefficient", "damping_time")
"""Columns of the `parameters` array: EI over nominal EI [-], Coulomb coefficient [-], Kelvin-Voigt time [s]."""


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Ranges (low, high) of factors on the nominal parameters, drawn log-uniformly per trajectory; None = nominal.

    Wang et al., RA-L 2022, randomise stiffness and damping by factors of 0.1 to 3.

    Attributes:
        stiffness, damping, friction: range of the factor on bending stiffness, damping time and friction coefficient.
    """

    stiffness: tuple[float, float] | None = None
    damping: tuple[float, float] | None = None
    friction: tuple[float, float] | None = None

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None and not (
                len(value) == 2 and all(factor in LIMITS["factor"] for factor in value) and value[0] <= value[1]
            ):
                raise ValueError(
                    f"Randomisation.{field.name} is {shown(value)}, expected None or factors (low, high), each "
                    f"{LIMITS['factor']}, low <= high."
                )


@dataclasses.dataclass(frozen=True)
class DatasetConfig:
    """Everything that decides the content of a data set. The defaults follow Wang et al., RA-L 2022, section V.

    Attributes:
        n_trajectories: number of trajectories M.
        n_steps: commands T per trajectory.
        interval: time each command is held [s].
        seed: trajectory i depends on (seed, i) only, never on who makes it or when.
        motion: where the grippers start and how they move.
        discretisation: the simulated cable, its links and time step; see `Engine.data_timestep`.
        randomisation: ranges of the physical parameters.
        engine: "chain", batched in JAX, the fastest, which can simulate every effect; "mjx", batched too; or
            "threaded", C MuJoCo in threads on the CPU.
        shard_size: trajectories per shard, the unit that one process writes and that a kill can lose.
        effects: added to every cable after its parameters are drawn, in this order. A ratio multiplies what was drawn,
            and so does the coefficient of `table_friction`, as a ratio to the nominal one.
        posterior: sets of effects, equally probable; after `effects`, trajectory i gets the one of number i modulo
            their number. See `cablejax.effects.verdicts.posterior_of_verdict`.
    """

    n_trajectories: int = 2000
    n_steps: int = 200
    interval: float = 1.0
    seed: int = 0
    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    discretisation: Discretisation = Discretisation(timestep=ChainEngine.data_timestep)
    randomisation: Randomisation = dataclasses.field(default_factory=Randomisation)
    engine: Literal["chain", "mjx", "threaded"] = "chain"
    shard_size: int = 32
    effects: tuple[GivenEffect, ...] = ()
    posterior: tuple[tuple[GivenEffect, ...], ...] = ()

    def __post_init__(self):
        check(self, "shard_size", "interval", "seed", n_trajectories="trajectories", n_steps="commands")
        if self.engine not in ENGINES:
            raise ValueError(f"DatasetConfig.engine is {self.engine!r}, expected one of {', '.join(ENGINES)}.")
        if self.discretisation.dimension != 2:
            raise ValueError(
                "DatasetConfig.discretisation has dimension 3; data sets hold cables on a table: use dimension=2."
            )
        if self.discretisation.n_links < FEWEST_LINKS:
            raise ValueError(
                f"DatasetConfig.discretisation has n_links {self.discretisation.n_links}, expected at least "
                f"{FEWEST_LINKS}: with fewer the grippers' poses leave it no freedom."
            )
        check_effects([effect for effects in (self.effects, *self.posterior) for effect in effects], self.engine)
        ENGINES[self.engine](self.discretisation).substeps(self.interval)  # pyright: ignore[reportCallIssue]
        for index in range(len(self.posterior) or bool(self.effects)):
            with_effects(nominal_physics(self.discretisation), self.effects_of(index), self.discretisation)

    @property
    def cable(self) -> Cable:
        """The simulated cable."""
        return self.discretisation.cable

    def effects_of(self, index: int) -> tuple[GivenEffect, ...]:
        """The effects of trajectory `index`."""
        return self.effects + (self.posterior[index % len(self.posterior)] if self.posterior else ())

    @property
    def asymmetric(self) -> tuple[str, ...]:
        """Names of what makes its cables asymmetric under mirroring or exchange of ends; empty if nothing does."""
        names = sorted(name for name in self.effect_names if not EFFECTS[name].symmetric)
        return (*names, *(["rest_curvature_per_m"] if self.cable.rest_curvature else []))

    @property
    def untrainable(self) -> tuple[str, ...]:
        """The effects on which no model is trained, see `effects.OUTSIDE`."""
        return tuple(sorted(self.effect_names & OUTSIDE))

    @property
    def trainable(self) -> bool:
        """Whether models are trained on such data.

        Without `untrainable` effects, with at least three keypoints, evenly spaced, and two trajectories, of which one
        is held out.
        """
        spaced = self.cable.marks is None and self.cable.n_keypoints in LIMITS["at_least_three"]
        return spaced and not self.untrainable and self.n_trajectories > 1

    @property
    def effect_names(self) -> frozenset[str]:
        """Names of all effects that any trajectory has."""
        return frozenset(effect.name for effects in (self.effects, *self.posterior) for effect in effects)

    @property
    def effects_shown(self) -> tuple[str, ...]:
        """The effects in words: those of all trajectories, and how often each occurs in the posterior."""
        drawn = Counter(name for one in self.posterior for name in {effect.name for effect in one})
        often = (f"{name} (in {count} of {len(self.posterior)} draws)" for name, count in drawn.most_common())
        return (*map(str, self.effects), *often)

    @property
    def n_shards(self) -> int:
        """Number of shards; the last one may be smaller."""
        return -(-self.n_trajectories // self.shard_size)

    def shard_rows(self, shard: int) -> range:
        """Trajectory indices of one shard."""
        first = shard * self.shard_size
        return range(first, min(first + self.shard_size, self.n_trajectories))

    def array_shapes(self) -> dict[str, tuple[tuple[int, ...], str]]:
        """Shape of one trajectory and dtype of every array in the store that holds data."""
        steps, points = self.n_steps, self.cable.n_keypoints
        return {
            "keypoints": ((steps + 1, points, 2), "float32"),
            "gripper_pose": ((steps + 1, 2, 3), "float32"),
            "gripper_twist": ((steps, 2, 3), "float32"),
            "parameters": ((len(PARAMETERS),), "float64"),
            "attempts": ((), "int32"),
        }


@dataclasses.dataclass(frozen=True)
class Block:
    """Some trajectories in memory, as NumPy arrays. All but `parameters` and `attempts` is what an engine returned.

    Attributes:
        keypoints: [m], float32, shape [B, T + 1, N, 2].
        gripper_pose: (x, y, theta), float32, shape [B, T + 1, Q, 3].
        gripper_twist: twist held from sample t to t + 1 [m/s, rad/s], float32, shape [B, T, Q, 3].
        parameters: the columns of `PARAMETERS`, float64, shape [B, 3].
        attempts: motions drawn in vain before this one, int32, shape [B].
    """

    keypoints: np.ndarray
    gripper_pose: np.ndarray
    gripper_twist: np.ndarray
    parameters: np.ndarray
    attempts: np.ndarray

    def __len__(self) -> int:
        return len(self.keypoints)

    def digests(self) -> np.ndarray:
        """SHA-256 of every trajectory's bytes (little-endian, in the order of the fields), uint8, shape [B, 32]."""
        arrays = [getattr(self, field.name) for field in dataclasses.fields(self)]
        arrays = [np.ascontiguousarray(array, array.dtype.newbyteorder("<")) for array in arrays]
        digests = [
            hashlib.sha256(b"".join(array[row].tobytes() for array in arrays)).digest() for row in range(len(self))
        ]
        return np.frombuffer(b"".join(digests), np.uint8).reshape(len(self), 32)


def config_to_json(config: Any) -> dict[str, Any]:
    """A (nested) configuration as a JSON object."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def config_from_json(cls: type, value: Mapping[str, Any]) -> Any:
    """The inverse of `config_to_json`. A field that the record does not know yet takes its default.

    Raises:
        ValueError: the record has a field that this version does not know; the message names it.
    """
    if not isinstance(value, Mapping):
        raise ValueError(f"The recorded {cls.__name__} is {shown(value)}, expected an object.")
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(value) - {field.name for field in dataclasses.fields(cls)})
    if unknown:
        raise ValueError(
            f"The recorded {cls.__name__} has the unknown {', '.join(unknown)}: another version of cablejax wrote it. "
            "Read it with that version, or make the data set again."
        )
    try:
        return cls(**{name: _decode(hints[name], item) for name, item in value.items()})
    except (TypeError, AttributeError) as error:
        raise ValueError(f"The recorded {cls.__name__} has a value of another type: {error}.") from error


def config_of_version_1(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration that a store of version 1 recorded, as version 2 records it: the cable apart from its links."""
    cable = recorded.get("cable") if isinstance(recorded, Mapping) else None
    if not isinstance(cable, Mapping):
        raise ValueError(f"The configuration of version 1 has the cable {shown(cable)}, expected an object.")
    links = {field.name for field in dataclasses.fields(Discretisation)}
    return {
        **{name: value for name, value in recorded.items() if name != "cable"},
        "discretisation": {
            **{name: value for name, value in cable.items() if name in links},
            "cable": {name: value for name, value in cable.items() if name not in links},
        },
    }


def _decode(hint: Any, value: Any) -> Any:
    if value is None:
        return None
    if dataclasses.is_dataclass(hint):
        return config_from_json(typing.cast(type, hint), value)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _decode(next(option for option in typing.get_args(hint) if option is not type(None)), value)
    if isinstance(value, list):
        items, repeated = typing.get_args(hint), typing.get_args(hint)[1:] == (...,)
        return tuple(_decode(items[0], item) for item in value) if repeated else tuple(value)
    return value


def digest_of_config(config: Mapping[str, Any]) -> str:
    """SHA-256 of a configuration's canonical JSON."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
