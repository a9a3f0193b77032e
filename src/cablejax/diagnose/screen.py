"""The first look at every effect: finite templates, and how much of the gap each could explain."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.effects.base import Context, Effect
from cablejax.diagnose.fit import Candidate, Evidence, candidate

# How far a template is stretched, at most, to meet the gap.
_LARGEST_AMPLITUDE = 3.0


@dataclasses.dataclass(frozen=True)
class Template:
    """What one start of one effect does to the keypoints, against the gap.

    Attributes:
        start: the candidate, moved along its amplitude to meet the gap where that is possible.
        similarity: squared cosine between the template and the gap, the noise taken out of the latter; at most about 1.
    """

    start: Candidate
    similarity: float


def screen(
    evidence: Evidence,
    base: Candidate,
    effects: Sequence[Effect],
    context: Context,
) -> list[Template]:
    """Templates of every start of every effect on top of a base explanation.

    An effect of finite size, not a derivative, is held against the gap: a cable that does not yield, slip or touch at
    the null value has no derivative there.
    """
    playback = evidence.playback
    nominal, config = playback.nominal(), playback.config
    begin = _parts(base)
    starts = [
        candidate(*begin, (effect, variant, values))
        for effect in effects
        for variant, values in effect.starts(context)
    ]
    simulated = playback.keypoints([base.physics(nominal, config), *(s.physics(nominal, config) for s in starts)])
    residuals = evidence.residuals(simulated).reshape(1 + len(starts), -1)
    gap = -residuals[0]
    power = max(float(gap @ gap) - float(evidence.count.sum()), 1e-6)
    result = []
    for start, moved in zip(starts, residuals[1:], strict=True):
        template = moved - residuals[0]
        size = float(template @ template)
        if not np.isfinite(size) or size < 1e-6:
            continue
        product = float(template @ gap)
        similarity = product**2 / size / power
        # a template that points the other way explains nothing, unless it may be reversed
        stretched = _stretch(start, len(base.z), product / size)
        if stretched is None:
            similarity, stretched = 0.0, start
        result.append(Template(start=stretched, similarity=similarity))
    return result


def _parts(base: Candidate):
    return [(t.effect, t.variant, v) for t, v in zip(base.terms, base.values(), strict=True)]


def _stretch(start: Candidate, n_base: int, amplitude: float) -> Candidate | None:
    """The start with its effect's amplitude times `amplitude`; None where it cannot point that way."""
    effect = start.terms[-1].effect
    if effect.amplitude is None:
        return start if amplitude > 0 else None
    if amplitude <= 0 and not effect.reversible:
        return None
    amplitude = float(np.clip(amplitude, -_LARGEST_AMPLITUDE, _LARGEST_AMPLITUDE))
    z = start.z.copy()
    index = n_base + effect.amplitude
    parameter = effect.parameters[effect.amplitude]
    null = parameter.coordinate(effect.null[effect.amplitude]) if np.isfinite(effect.null[effect.amplitude]) else None
    if null is not None:
        z[index] = np.clip(null + amplitude * (z[index] - null), *parameter.z_bounds)
    return dataclasses.replace(start, z=z)


def shortlist(templates: Sequence[Template], per_variant: int = 1, per_effect: int = 3) -> list[Candidate]:
    """The best starts: so many of each effect, of these so many of each variant."""
    chosen: list[Candidate] = []
    taken: dict[str, int] = {}
    variants: dict[tuple[str, int], int] = {}
    for template in sorted(templates, key=lambda t: -t.similarity):
        term = template.start.terms[-1]
        name, key = term.effect.name, (term.effect.name, term.variant)
        if taken.get(name, 0) < per_effect and variants.get(key, 0) < per_variant:
            chosen.append(template.start)
            taken[name] = taken.get(name, 0) + 1
            variants[key] = variants.get(key, 0) + 1
    return chosen


def residual_of(evidence: Evidence, fitted: Candidate) -> Float[np.ndarray, "E T N 2"]:
    """Observed less simulated keypoints under a candidate [m]."""
    playback = evidence.playback
    simulated = playback.keypoints([fitted.physics(playback.nominal(), playback.config)])[0]
    return evidence.target - simulated
