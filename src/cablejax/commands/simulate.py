"""`cablejax simulate`: generates a data set of cables moved at random."""

from __future__ import annotations

import dataclasses
import pathlib
import shlex
import time
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from cablejax.commands.cable import cable_of_verdict, check_verdicts, find_cable
from cablejax.commands.options import SeededCommand, UsageError, say
from cablejax.whole_file import draft_folder, sole_writer

if TYPE_CHECKING:
    from cablejax.cable import Cable
    from cablejax.dataset.bucket import Bucket
    from cablejax.dataset.schema import DatasetConfig
    from cablejax.effects.given import GivenEffect


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulate(SeededCommand):
    """Simulate random two-gripper motions of a cable and store them as training data.

    The command can be interrupted at any time, and resumes when it is run again. Several processes may share the work,
    each with its own --process-index; the result does not depend on their number.

    Attributes:
        out: Folder of the data set (a Zarr v3 store), or its place in object storage, s3://BUCKET/PREFIX.
        trajectories: How many trajectories to simulate.
        steps: Commands per trajectory, one second each.
        start: How each cable lies at first: straight, or at rest between gripper poses drawn at random.
        max_amplification: Largest movement of any point of the frictionless cable, relative to the sum of the grippers'
            movements. This limit keeps the cable from snapping through; 1000 lets it snap.
        engine: chain: closed-form time step, batched in JAX; the fastest, supports every effect. mjx: the same cable in
            MJX. threaded: C MuJoCo on all CPU cores.
        timestep: Time step of the simulation [s]; by default 0.05 for the chain and 0.02 for the others, which are
            about equally accurate.
        cable: The cable to simulate: a cable file (see `cablejax cable`), or a data set, trained weights or a log that
            holds a cable. By default that of the verdicts in --with, else the reference cable.
        effect: An effect to add to every cable, as NAME:PARAMETER=VALUE,... in SI units; may be given several times.
        with_: A verdict.json of `cablejax diagnose`: adds the named effects, each trajectory with another draw of the
            verdict's posterior; may be given several times.
        links: Links of the simulated cable; by default as many as in the released model's training data.
        stiffness_range: Draw each cable's stiffness between these two factors of the nominal one, log-uniformly; by
            default all are equal.
        damping_range: Draw each cable's damping time likewise.
        friction_range: Draw each cable's friction coefficient likewise.
        process_index: Number of this process, from 0.
        process_count: How many processes share the work.
        overwrite: Delete an existing data set that was made with other options. Nothing else is ever deleted.
    """

    resume_hint: ClassVar[str] = "What was complete is kept; run the same command again to go on."

    out: pathlib.Path = pathlib.Path("runs/data.zarr")
    trajectories: int = 2000
    steps: int = 200
    start: Literal["straight", "random"] = "straight"
    max_amplification: float = 1.5
    engine: Literal["chain", "mjx", "threaded"] = "chain"
    timestep: float | None = None
    cable: pathlib.Path | None = None
    effect: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    with_: Annotated[tuple[pathlib.Path, ...], tyro.conf.arg(name="with"), tyro.conf.UseAppendAction] = ()
    links: int | None = None
    stiffness_range: tuple[float, float] | None = None
    damping_range: tuple[float, float] | None = None
    friction_range: tuple[float, float] | None = None
    process_index: int = 0
    process_count: int = 1
    overwrite: bool = False

    def execute(self):
        """Generates what the store lacks and returns its size and digest."""
        from cablejax.dataset.bucket import place_of
        from cablejax.dataset.generate import generate

        config, place = self.dataset_config(), place_of(self.out)
        if self.overwrite:
            _clear(place, config)
        say(f"{config.n_trajectories} trajectories of {config.n_steps} steps into {place}")
        if config.untrainable:
            names = ", ".join(config.untrainable)
            say(f"No model can be trained on data with {names}: it learns the cable, not its camera or its arms.")
        if config.cable.marks is not None:
            say(
                "No model can be trained on keypoints at given arc lengths: to train on these data, write `keypoints = "
                f"{config.cable.n_keypoints}` into the cable file in place of keypoint_arclength_m."
            )
        begin = time.perf_counter()
        info = generate(config, place, process_index=self.process_index, process_count=self.process_count)
        seconds = time.perf_counter() - begin
        result = {
            "path": str(place),
            "trajectories": config.n_trajectories,
            "complete": info.n_complete,
            "digest": info.digest,
            "seconds": round(seconds, 3),
        }
        made = f"{info.n_complete} of {config.n_trajectories} trajectories are in {place} ({seconds:.0f} s)."
        ready = info.n_complete == config.n_trajectories and config.trainable
        return result, f"{made}\nTrain on them: cablejax train --data {shlex.quote(str(place))}" if ready else made

    def dataset_config(self) -> DatasetConfig:
        """The data set that these options describe.

        Raises:
            ValueError: an option is out of its range, or a file that it names cannot be used.
        """
        from cablejax.cable import Cable
        from cablejax.effects.given import parse_effect
        from cablejax.effects.verdicts import posterior_of_verdict

        effects = tuple(parse_effect(text) for text in self.effect)
        verdicts = [posterior_of_verdict(path) for path in self.with_]
        together = tuple(
            tuple(effect for posterior in verdicts for effect in posterior[i % len(posterior)])
            for i in range(max(map(len, verdicts), default=1))
        )
        if len(together) == 1:
            effects, together = effects + together[0], ()
        if self.cable is not None:
            cable = find_cable(self.cable)
        else:
            cable = next(filter(None, map(cable_of_verdict, self.with_)), Cable())
        check_verdicts(self.with_, cable, "Leave --cable out to simulate the verdict's.")
        for name, nominal in (("friction", cable.friction_coefficient), ("damping", cable.damping_time)):
            if getattr(self, f"{name}_range") is not None and nominal == 0:
                raise UsageError(
                    f"--{name}-range is given, but the cable has no {name}, and factors of 0 are 0: leave it out, or "
                    "give the cable some."
                )
        config = self.config_of(cable, effects)
        return dataclasses.replace(config, posterior=together)

    def config_of(self, cable: Cable, effects: tuple[GivenEffect, ...]) -> DatasetConfig:
        """The data set of a cable with effects, in place of those that the options name.

        Motions and bends scale with the cable's length, see `MotionConfig.for_length`.
        """
        from cablejax.cable import Discretisation
        from cablejax.dataset.schema import DatasetConfig, Randomisation
        from cablejax.simulate import ENGINES
        from cablejax.simulate.motions import MotionConfig

        return DatasetConfig(
            n_trajectories=self.trajectories,
            n_steps=self.steps,
            seed=self.seed,
            motion=MotionConfig.for_length(cable.length, start=self.start, max_amplification=self.max_amplification),
            discretisation=Discretisation(
                cable,
                n_links=Discretisation.n_links if self.links is None else self.links,
                timestep=ENGINES[self.engine].data_timestep if self.timestep is None else self.timestep,
            ),
            randomisation=Randomisation(
                stiffness=self.stiffness_range, damping=self.damping_range, friction=self.friction_range
            ),
            engine=self.engine,
            effects=effects,
        )


def _clear(place: pathlib.Path | Bucket, config: DatasetConfig) -> None:
    """Deletes a data set of another configuration; refuses what is none, holds other files, or is being written."""
    from cablejax.dataset.bucket import Bucket
    from cablejax.dataset.generate import WRITER
    from cablejax.dataset.opening import recorded_store

    if isinstance(place, Bucket):
        names = place.names()
    else:
        names = [file.name for file in place.iterdir()] if place.is_dir() else []
    if not names or (old := recorded_store(place)).config == config:
        return
    others = {name.partition("/")[0] for name in names} - old.names
    if others := sorted(name for name in others if not name.startswith(WRITER)):
        raise UsageError(
            f"{place} holds {', '.join(others[:5])} besides a data set, which --overwrite would delete with it. Move "
            "the rest elsewhere, or give another place with --out."
        )
    if isinstance(place, Bucket):
        place.remove(names)
    else:
        for writer in place.glob(f"{WRITER}*"):
            with sole_writer(writer):
                pass
        # whole or not at all: what is left without its head is no data set
        place = place.resolve()  # not a link to it
        with draft_folder(place) as old:
            place.rename(old)
