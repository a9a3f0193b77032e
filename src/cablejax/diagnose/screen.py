"""Screens effects: how much of the gap a finite template of each could explain."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.protocol import Explanation
from cablejax.effects.effect import Effect

# How far a template is stretched, at most, to meet the gap.
_LARGEST_AMPLITUDE = 3.0


@dataclasses.dataclass(frozen=True)
class Template:
    """Change of the observations by one start of one effect, compared with the gap.

    Attributes:
        start: the explanation, moved along its amplitude to meet the gap where that is possible.
        explained: share of the squared gap that it takes away, the noise taken out of the gap: of the template at its
            best length where a parameter decides on that, else of the template as it is. At most about 1.
        weighed: whether episodes are weighted as in a fit from the base, instead of by their squares alone: where the
            cable snaps through, one episode dominates the squares, and no template matches it.
    """

    start: Explanation
    explained: float
    weighed: bool = False


def screen(
    evidence: Evidence, base: Explanation, effects: Sequence[Effect], predicted: Float[np.ndarray, "E T *O"]
) -> list[Template]:
    """Templates of every start of every effect on top of a base explanation, by all squares and weighed.

    The gap is compared with an effect of finite size, not with a derivative: a cable that does not yield, slip or touch
    at the null value has no derivative there.

    Args:
        evidence: to explain.
        base: what every template is added to.
        effects: to try.
        predicted: by the base.
    """
    residual = evidence.observed - predicted
    starts = [
        base.plus((effect, variant, values))
        for effect in effects
        for variant, values in evidence.simulator.starts(effect, predicted, residual)
    ]
    residuals = evidence.whitened(evidence.predict([base, *starts]))
    gap = -residuals[0]
    squares, ones = (gap**2).sum(axis=-1), np.ones(len(gap))
    result = []
    for weighed, weight in ((False, ones), (True, evidence.weight(squares))):
        power = max(float(weight @ (squares - evidence.count)), 1e-6)
        for start, moved in zip(starts, residuals[1:], strict=True):
            template = moved - residuals[0]
            size, product = (float(weight @ (template * by).sum(axis=-1)) for by in (template, gap))
            if not np.isfinite(size) or size < 1e-6:
                continue
            stretched = _stretch(start, len(base.z), product / size)
            if stretched is None:
                result.append(Template(start, (2 * product - size) / power, weighed))
            else:
                result.append(Template(stretched, product**2 / size / power, weighed))
    return result


def _stretch(start: Explanation, n_base: int, amplitude: float) -> Explanation | None:
    """The start with its last effect made `amplitude` times as large; None where no parameter does that."""
    effect = start.terms[-1].effect
    if effect.amplitude is None or (amplitude <= 0 and not effect.reversible):
        return None
    amplitude = float(np.clip(amplitude, -_LARGEST_AMPLITUDE, _LARGEST_AMPLITUDE))
    index = n_base + effect.amplitude
    parameter, null = effect.parameters[effect.amplitude], effect.null[effect.amplitude]
    z = start.z.copy()
    if parameter.log and null in (0.0, np.inf):
        # the effect grows with the value, or with its inverse
        factor = amplitude if null == 0.0 else 1.0 / amplitude
        z[index] = parameter.coordinate(float(parameter.value(np.float64(z[index]))) * factor)
    else:
        origin = parameter.coordinate(null)
        z[index] = origin + amplitude * (z[index] - origin)
    z[index] = np.clip(z[index], *parameter.z_bounds)
    return start.moved(z)


def shortlist(
    templates: Sequence[Template], per_variant: int = 3, per_effect: int = 3, *, weighed: bool = False
) -> list[Explanation]:
    """The best starts of one kind of template, at most so many per effect and per variant."""
    chosen: list[Explanation] = []
    taken: dict[str, int] = {}
    variants: dict[tuple[str, int], int] = {}
    for template in sorted((t for t in templates if t.weighed is weighed), key=lambda t: -t.explained):
        term = template.start.terms[-1]
        name, key = term.effect.name, (term.effect.name, term.variant)
        if taken.get(name, 0) < per_effect and variants.get(key, 0) < per_variant:
            chosen.append(template.start)
            taken[name] = taken.get(name, 0) + 1
            variants[key] = variants.get(key, 0) + 1
    return chosen
