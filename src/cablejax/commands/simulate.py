"""`cablejax simulate`: a data set of cables moved at random."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from typing import TYPE_CHECKING, ClassVar, Literal

from cablejax.commands.options import Command, say

if TYPE_CHECKING:
    from cablejax.dataset.schema import DatasetConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate random two-gripper motions of a cable and store them as training data.

    The store can be interrupted at any time: the same command goes on where it stopped. Several processes may share
    the work, each with its own --process-index; the result does not depend on how many there are."""

    resume_hint: ClassVar[str] = "What was complete is kept; run the same command again to go on."

    out: pathlib.Path = pathlib.Path("runs/data.zarr")
    """Folder of the data set (a Zarr v3 store)."""

    trajectories: int = 2000
    """How many trajectories to simulate."""

    steps: int = 200
    """Commands per trajectory, one second each."""

    start: Literal["straight", "random"] = "straight"
    """How each cable lies at first."""

    max_amplification: float = 1.5
    """Largest movement of any point of the frictionless cable, relative to what the grippers move together. It keeps
    the cable from snapping through; 1000 lets it snap."""

    engine: Literal["threaded", "mjx", "chain"] = "threaded"
    """threaded: C MuJoCo on all CPU cores. mjx: batched in JAX, for an accelerator."""

    links: int | None = None
    """Links of the simulated cable; by default the resolution that the released model was trained on."""

    stiffness: float = 0.02
    """Bending stiffness of the cable [N m^2]."""

    friction: float = 0.1
    """Coulomb friction coefficient of the table; 0 for no table."""

    stiffness_range: tuple[float, float] | None = None
    """Draw each cable's stiffness between these two factors of --stiffness; by default all are alike."""

    damping_range: tuple[float, float] | None = None
    """Draw each cable's damping time between these two factors of the nominal one."""

    friction_range: tuple[float, float] | None = None
    """Draw each cable's friction coefficient between these two factors of --friction."""

    process_index: int = 0
    """Number of this process, from 0."""

    process_count: int = 1
    """How many processes share the work."""

    overwrite: bool = False
    """Delete a data set that is there and was made by other options. Nothing else is ever deleted."""

    def execute(self):
        import shutil

        from cablejax.dataset.generate import generate
        from cablejax.dataset.store import open_store

        config = self.dataset_config()
        if self.overwrite and self.out.is_dir() and any(self.out.iterdir()) and open_store(self.out).config != config:
            shutil.rmtree(self.out)
        say(f"{config.n_trajectories} trajectories of {config.n_steps} steps into {self.out}")
        begin = time.perf_counter()
        info = generate(config, self.out, process_index=self.process_index, process_count=self.process_count)
        seconds = time.perf_counter() - begin
        result = {
            "path": str(self.out),
            "trajectories": config.n_trajectories,
            "complete": info.n_complete,
            "digest": info.digest,
            "seconds": round(seconds, 3),
        }
        return result, (
            f"{info.n_complete} of {config.n_trajectories} trajectories are in {self.out} ({seconds:.0f} s).\n"
            f"Train on them: cablejax train --data {self.out}"
        )

    def dataset_config(self) -> DatasetConfig:
        """What these options ask for.

        Raises:
            ValueError: an option is out of its range.
        """
        from cablejax.cable import Cable, Discretisation
        from cablejax.dataset.schema import DatasetConfig, Randomisation
        from cablejax.simulate.motions import MotionConfig

        chain = Discretisation(Cable(bending_stiffness=self.stiffness, friction_coefficient=self.friction))
        if self.links is not None:
            chain = dataclasses.replace(chain, n_links=self.links)
        return DatasetConfig(
            n_trajectories=self.trajectories,
            n_steps=self.steps,
            seed=self.seed,
            motion=MotionConfig(start=self.start, max_amplification=self.max_amplification),
            discretisation=chain,
            randomisation=Randomisation(
                stiffness=self.stiffness_range, damping=self.damping_range, friction=self.friction_range
            ),
            engine=self.engine,
        )
