"""Configuration of a training: phases, optimiser, and outputs."""

from __future__ import annotations

import dataclasses

import optax

from cablejax.dynamics.config import ModelConfig
from cablejax.limits import check


@dataclasses.dataclass(frozen=True)
class Phase:
    """A stretch of training with one kind of loss.

    Attributes:
        steps: optimiser steps.
        batch: windows per step.
        rollout: steps K that the model is rolled out and compared with the truth.
        noise: final standard deviation of the random walk added to the history, as a share of the cable's length; 0 =
            none.
        lr_start: learning rate at the phase's beginning; it falls like half a cosine.
        lr_end: at its end.
    """

    steps: int
    batch: int = 32
    rollout: int = 1
    noise: float = 3e-4
    lr_start: float = 1e-3
    lr_end: float = 1e-4

    def __post_init__(self):
        check(
            self,
            "batch",
            noise="noise_share",
            steps="optimiser_steps",
            rollout="commands",
            lr_start="learning_rate",
            lr_end="learning_rate",
        )


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the outcome of a training. The number of steps is fixed, never the time.

    Attributes:
        model: sizes of the network; its normalisation is replaced by one measured on the training data.
        phases: one after the other; optimiser state and averaged weights carry over.
        flips: whether windows are mirrored and reversed at random. For a uniform straight cable these are as likely as
            the originals; for a cable with an effect at one place or on one side they are not.
        seed: of initial weights, windows, augmentation and noise.
        warmup: optimiser steps over which the learning rate rises from 0.
        weight_decay: of AdamW.
        clip: largest global gradient norm.
        ema: decay of the moving average of the weights, which is evaluated and saved.
        chunk: optimiser steps per compiled call.
        checkpoint_every: chunks between checkpoints.
        evaluate_every: chunks between open-loop evaluations.
        evaluate_starts: most start points per evaluation.
    """

    model: ModelConfig = ModelConfig()
    phases: tuple[Phase, ...] = (
        Phase(steps=30_000, batch=32, rollout=1, noise=1e-4, lr_start=1e-3, lr_end=2e-4),
        Phase(steps=12_000, batch=16, rollout=4, noise=3e-5, lr_start=2e-4, lr_end=1e-6),
    )
    flips: bool = True
    seed: int = 0
    warmup: int = 500
    weight_decay: float = 1e-6
    clip: float = 1.0
    ema: float = 0.999
    chunk: int = 50
    checkpoint_every: int = 20
    evaluate_every: int = 40
    evaluate_starts: int = 128

    def __post_init__(self):
        if not self.phases:
            raise ValueError("TrainConfig.phases is empty, expected at least one Phase.")
        counts = ("chunk", "checkpoint_every", "evaluate_every", "evaluate_starts")
        check(self, "seed", **dict.fromkeys(counts, "count"))
        if not 0 <= self.ema < 1:
            raise ValueError(f"TrainConfig.ema is {self.ema}, expected 0 <= ema < 1.")

    @property
    def total_steps(self) -> int:
        """Optimiser steps of all phases."""
        return sum(phase.steps for phase in self.phases)

    @property
    def longest_rollout(self) -> int:
        """Largest number of steps rolled out in any phase."""
        return max(phase.rollout for phase in self.phases)

    def phase_at(self, step: int) -> tuple[int, int]:
        """Index of the phase that optimiser step `step` belongs to, and the step at which that phase ends."""
        end = 0
        for index, phase in enumerate(self.phases):
            end += phase.steps
            if step < end:
                return index, end
        return len(self.phases) - 1, end

    def calls_before(self, step: int) -> int:
        """Compiled calls that end at optimiser step `step` or before; a call ends with its phase at the latest."""
        calls = 0
        for phase in self.phases:
            calls += -(-min(step, phase.steps) // self.chunk)
            step -= min(step, phase.steps)
        return calls

    def learning_rate(self) -> optax.Schedule:
        """Learning rate as a function of the optimiser step."""
        parts, ends, end = [], [], 0
        for phase in self.phases:
            parts.append(optax.cosine_decay_schedule(phase.lr_start, phase.steps, phase.lr_end / phase.lr_start))
            end += phase.steps
            ends.append(end)
        schedule = optax.join_schedules(parts, ends[:-1])
        if self.warmup == 0:
            return schedule
        rise = optax.linear_schedule(0.0, 1.0, self.warmup)
        return lambda step: rise(step + 1) * schedule(step)

    def optimiser(self) -> optax.GradientTransformation:
        """AdamW on clipped gradients."""
        return optax.chain(
            optax.clip_by_global_norm(self.clip), optax.adamw(self.learning_rate(), weight_decay=self.weight_decay)
        )


PRESETS: dict[str, TrainConfig] = {
    "released": TrainConfig(),
    "small": TrainConfig(
        model=ModelConfig(latent=64, hidden=64, message_passing=3),
        phases=(
            Phase(steps=1_200, batch=16, rollout=1, noise=1e-4, lr_start=1e-3, lr_end=2e-4),
            Phase(steps=300, batch=16, rollout=4, noise=3e-5, lr_start=2e-4, lr_end=1e-6),
        ),
        warmup=100,
        evaluate_every=5,
        checkpoint_every=5,
    ),
    "smoke": TrainConfig(
        model=ModelConfig(latent=8, hidden=8, hidden_layers=1, message_passing=1),
        phases=(Phase(steps=4, batch=4, rollout=1), Phase(steps=2, batch=2, rollout=2)),
        warmup=2,
        chunk=2,
        evaluate_every=2,
        checkpoint_every=1,
        evaluate_starts=8,
    ),
}
"""Trainings by name: that of the released model (hours), one to compare variants by (minutes), one that shows that all
parts run (seconds)."""
