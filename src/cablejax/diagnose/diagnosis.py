"""The result of a diagnosis."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from cablejax.diagnose.rounds import Rounds
    from cablejax.diagnose.where import Where
    from cablejax.types import GapLog

Verdict = Literal["none", "named", "ambiguous", "named+unknown", "unknown"]
"""No gap; one cause; one of several; a part of the gap; no cause in the library."""

SEPARABLE = 0.1
"""A motion that is expected to remove less than this share of the doubt does not separate its explanations."""

PLACES = ("along_cable_m", "time_s", "table_m")
"""Place of an effect, by the keys of the verdict."""


@dataclasses.dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of a named effect.

    Attributes:
        value: in `unit`; an integer or a list of integers for a choice such as the gripper.
        ci90: 90 % interval; None for a choice, and where none was computed.
        unit: "" for a pure number.
    """

    value: Any
    ci90: tuple[float, float] | list[tuple[float, float]] | None
    unit: str


@dataclasses.dataclass(frozen=True)
class NamedEffect:
    """An effect that the diagnosis holds to be (part of) the cause.

    Attributes:
        name: from the gap log's list of names.
        probability: posterior that this effect is a cause, among all explanations with it or with another effect in its
            place, were the cause one of those that were tried; beside an unknown cause, times the share of such names
            that are causes (`Simulator.beside_unknown`). None where nothing of the kind was computed.
        parameters: by the names of the format.
        location: keys `PLACES`; None where an effect has no such place.
        alike: probability of each look-alike in its place, as its own, where it was computed.
    """

    name: str
    probability: float | None
    parameters: dict[str, ParameterEstimate]
    location: dict[str, Any]
    alike: dict[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class EffectValues:
    """One effect of a draw from the posterior.

    Attributes:
        name: as in `NamedEffect`.
        parameters: values by the names and in the units of `NamedEffect.parameters`.
    """

    name: str
    parameters: dict[str, float]


@dataclasses.dataclass(frozen=True)
class UnderLaw:
    """The verdict on the remaining explanations under another law of the simulator.

    Attributes:
        assumes: in words, as in "the grippers carry the cable's ends".
        probability: of this law among all that were tried, the simulator's own included.
        verdict, effects, equivalent: as in `Diagnosis`.
    """

    assumes: str
    probability: float
    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    equivalent: tuple[tuple[str, ...], ...]


@dataclasses.dataclass(frozen=True)
class Ranked:
    """One effect that was tried: alone, or in a forward search on top of those kept before it.

    Attributes:
        name: of the effect.
        probability: posterior among all single effects of the cable, were the cause one of them; of an effect of the
            arms, which is another question, among these and none. None where it was not computed, as in a forward
            search.
        held_out_shrinkage: share of the squared gap that goes away on episodes left out of the fit, from -1: negative
            where the effect makes these worse. NaN of an effect whose templates explained too little for a fit.
        leftover_mm: gap above the noise that is left, root mean square per coordinate [mm, or thousandths of
            `Gap.unit`], on the episodes fitted; of a forward search, on those left out.
        outcome: of a forward search: "kept", "did not help", or "not judged" where the simulation was lost with it.
    """

    name: str
    probability: float | None
    held_out_shrinkage: float
    leftover_mm: float
    outcome: str | None = None


@dataclasses.dataclass(frozen=True)
class Gap:
    """Size of the gap before and after, on held-out episodes. Root mean squares per coordinate [mm].

    Where `unit` is not the metre, whatever is called `_mm` is in thousandths of it.

    Attributes:
        horizon_s: over which the simulations run freely that are compared: the longest episode, or a window in space.
        before_rmse_mm, after_rmse_mm: nominal simulator, and with the named effects; noise included.
        noise_floor_mm: of the recording.
        shrinkage: `1 - (after^2 - floor^2) / (before^2 - floor^2)`; None where the gap is not
            resolvable, or nothing could be held out.
        shrinkage_ci90: by resampling episodes.
        ahead_mm: errors of predictions five seconds ahead of the last observation, by "nominal", "ridge" (the nominal
            simulator with a ridge residual, which knows no cause) and "named" (the simulator with the
            named effects, without a residual); None if no episode is long enough.
        horizons_mm: {seconds since the episode's start: (before, after)}.
        held_out_episodes: those scored; all of them where every episode was held out once.
        split: shares of the squared error before: "noise", "named", "learnable", "unexplained"; they sum to 1.
            "learnable" is what a ridge residual would take away of what is left; None where that was not computed,
            and then it is part of "unexplained".
        unit: of the observations.
    """

    horizon_s: float
    before_rmse_mm: float
    after_rmse_mm: float
    noise_floor_mm: float
    shrinkage: float | None
    shrinkage_ci90: tuple[float, float] | None
    ahead_mm: dict[str, float] | None
    horizons_mm: dict[float, tuple[float, float]]
    held_out_episodes: tuple[int, ...]
    split: dict[str, float | None]
    unit: str = "m"


@dataclasses.dataclass(frozen=True)
class NextMotion:
    """The motion with the most expected information about which explanation holds, or about the only one's parameters.

    Attributes:
        motion: "designed", or its name among `cablejax.diagnose.safe_motions`.
        separates: the explanations that the log leaves open, most probable first; empty if there is one only.
        information: lower bound on the expected information of its recording about which of them holds [nats]; of a
            single one, about its parameters.
        doubt: entropy of their probabilities, an upper bound on the information [nats]; 0 for a single one.
        alternatives: the information of every motion of the library that keeps all bounds, and of the designed one.
        poses: of the grippers (x, y, theta) [m, rad], shape [T, 2, 3].
        interval: time between two poses [s].
        shapes: keypoints as each explanation predicts them for that motion [m], shape [T, N, 2] each.
        ended: of the design's search: "clear" (next to no doubt would be left), "settled" (no better motion came) or
            "budget" (of simulations); None where nothing was designed.
    """

    motion: str
    separates: tuple[str, ...]
    information: float
    doubt: float
    alternatives: dict[str, float]
    poses: Float[np.ndarray, "T 2 3"]
    interval: float
    shapes: dict[str, Float[np.ndarray, "T N 2"]]
    ended: str | None = None

    @property
    def designed(self) -> tuple[Float[np.ndarray, "T 2 3"], float] | None:
        """Poses and interval of the motion where it was designed."""
        return None if self.ended is None else (self.poses, self.interval)

    @property
    def prior(self) -> float | None:
        """Probability that the right explanation has now, as a geometric mean; None where there is only one."""
        return math.exp(-self.doubt) if self.separates else None

    @property
    def certainty(self) -> float | None:
        """Probability that the right explanation is expected to have after the recording, as a geometric mean.

        None where there is one explanation only.
        """
        return math.exp(min(self.information - self.doubt, 0.0)) if self.separates else None

    @property
    def faint(self) -> bool:
        """Whether the motion would leave nearly all of the doubt."""
        return bool(self.separates) and self.information < SEPARABLE * self.doubt

    @property
    def inseparable(self) -> bool:
        """Whether even a searched motion is `faint`; never true for the safe motions alone."""
        return self.faint and self.ended is not None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Diagnosis of any simulator: the effect it lacks on a recording, and how far the gap shrinks with it.

    Fields that a simulator does not compute are None.

    Attributes:
        verdict: see the format.
        sentence: the verdict in words.
        effects: effects named as the cause; empty for "none" and "unknown".
        equivalent: sets of effects that are indistinguishable on this log.
        ranking: every effect tried, most probable first; of a forward search, every trial in order.
        undecided: whether the verdict is "unknown" because the log shows too little of the gap: effects of the library
            would explain it, and none can be named. In space, also where amplified noise hides whether there is one.
        leftover_p: chance that a right explanation leaves as much error as the best one, see `belief.leftover_p`; None
            without a gap, or without labelled logs like this one.
        gap: before and after.
        where: along the cable, in time, by regime, by frame; None where no adapter localises.
        next_motion: recommended motion; None if nothing would be gained, or no motion was evaluated.
        baselines: the single effect that simpler rules would have named: "lowest_cost" (best fit in sample), "bic" (the
            same with Schwarz's penalty, all samples taken to be independent) and "sparse_regression" (the best template
            without any fit); empty for the verdict "none".
        caveats: limits of the verdict, in words.
        seconds: run time.
        settings: versions and options, for the record.
        posterior: sets of effects, equally probable: draws of which explanation holds and of its parameters; empty
            where nothing is named.
        quantities: quantities of the system that the log identifies, whether or not an effect is named; empty if the
            adapter has none.
        under_laws: the verdict under other laws of the simulator; probabilities of look-alikes, intervals of `effects`
            and `posterior` cover all laws. Empty without a gap, or if the simulator offers none.
    """

    verdict: Verdict
    sentence: str
    effects: tuple[NamedEffect, ...]
    equivalent: tuple[tuple[str, ...], ...]
    ranking: tuple[Ranked, ...]
    undecided: bool = False
    leftover_p: float | None = None
    gap: Gap
    where: Where | None
    next_motion: NextMotion | None = None
    baselines: dict[str, str] = dataclasses.field(default_factory=dict)
    caveats: tuple[str, ...] = ()
    seconds: float
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    posterior: tuple[tuple[EffectValues, ...], ...] = ()
    under_laws: tuple[UnderLaw, ...] = ()
    quantities: dict[str, ParameterEstimate] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CableDiagnosis(Diagnosis):
    """The diagnosis of a cable between two grippers, with what its page shows.

    Attributes:
        where: along the cable, in time, by regime, by frame.
        log: what was diagnosed.
        rounds: what each recording added; None where the log is one recording, and in space.
        nominal: keypoints of the nominal simulator [m], NaN beyond an episode's end, shape [E, T, N, D].
        explained: keypoints of the simulator with the named (or best) effects, each episode from a fit that left it
            out [m], shape [E, T, N, D]; None for the verdict "none".
        noise_mm: standard deviation of each keypoint's coordinates [mm], shape [N].
        noise_correlation: autocorrelation of the noise at lags 1, 2, ... samples.
    """

    where: Where
    log: GapLog
    nominal: Float[np.ndarray, "E T N D"]
    explained: Float[np.ndarray, "E T N D"] | None
    noise_mm: Float[np.ndarray, "N"]
    noise_correlation: Float[np.ndarray, "K"]
    rounds: Rounds | None = None
