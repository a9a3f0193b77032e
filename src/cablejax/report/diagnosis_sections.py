"""The sections of a diagnosis' page: the words and tables that `templates/diagnosis.html` lays out."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence

from cablejax.diagnose.belief import BESIDE_UNKNOWN
from cablejax.diagnose.diagnosis import CableDiagnosis, Diagnosis, NamedEffect, UnderLaw
from cablejax.diagnose.judgement import effect_title, listed, look_alikes, share
from cablejax.effects import given
from cablejax.report.effect_words import (
    EFFECTS,
    between,
    effect_place,
    explanation_title,
    millimetres,
    parameter_title,
    quantity,
    share_removed,
)

# More episodes than this are counted, not listed.
_LISTED = 8
# An effect with less chance whose share is larger by this seems to contradict the first.
_CONTRADICTS = 0.1

_RULES = {
    "lowest_cost": "best fit to the log itself",
    "bic": "best fit with Schwarz's penalty",
    "sparse_regression": "best-matching template, not fitted",
}

Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""A heading, the names of the columns, and the rows."""


def named_effects(diagnosis: Diagnosis) -> list[tuple[NamedEffect, str, list[tuple[str, str]]]]:
    """Each named effect with its place, parameters and estimates."""
    found = []
    for effect in diagnosis.effects:
        meaning, place = EFFECTS.get(effect.name, "an effect of your own"), effect_place(effect)
        estimates = [
            (parameter_title(name), quantity(estimate.value, estimate.unit, estimate.ci90))
            for name, estimate in effect.parameters.items()
        ]
        found.append((effect, f"{meaning}, {place}" if place else meaning, estimates))
    return found


def quantities(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Quantities of the cable that the log identifies, whether or not an effect is named."""
    return [
        (parameter_title(name), quantity(one.value, one.unit, one.ci90)) for name, one in diagnosis.quantities.items()
    ]


def addable(diagnosis: Diagnosis) -> bool:
    """Whether the named effects can be added to the package's simulators; a user's own effects cannot."""
    return bool(diagnosis.effects) and all(effect.name in given.EFFECTS for effect in diagnosis.effects)


def alike(diagnosis: CableDiagnosis) -> list[tuple[list[str], list[str]]]:
    """Names of the effects that are indistinguishable on the log: those with a chance, and those without."""
    return [look_alikes(group, diagnosis.effects) for group in diagnosis.equivalent]


def under_other_laws(diagnosis: Diagnosis) -> list[str]:
    """The verdict under each other law of the simulator, in words."""
    said = [
        f"If {law.assumes}, {_verdict_under(law)}. Of all laws that were tried, this one has a probability of "
        f"{share(law.probability)} on this log."
        for law in diagnosis.under_laws
    ]
    over = "Probabilities of look-alikes are over all laws, intervals over those by which the same effects are found."
    return [*said, over] if diagnosis.effects and said else said


def _verdict_under(law: UnderLaw) -> str:
    if law.verdict == "none":
        return "no effect is needed"
    if law.verdict == "unknown":
        return "no effect of the library explains enough"
    named = []
    for effect in law.effects:
        # a place or a choice says less than how strong the effect is
        estimates = (
            f"{parameter_title(name)} {quantity(estimate.value, estimate.unit, estimate.ci90)}"
            for name, estimate in effect.parameters.items()
            if estimate.ci90 is not None
        )
        group = next((alike for alike in law.equivalent if effect.name in alike), (effect.name,))
        others = [effect_title(name) for name in group if name != effect.name]
        named.append(listed([f"{effect_title(effect.name)} ({', '.join(estimates)})", *others], "or"))
    unknown = ", and an unknown cause" if law.verdict == "named+unknown" else ""
    return f"the cause is {listed(named)}{unknown}"


def what_is_left(diagnosis: CableDiagnosis) -> str:
    """A sentence on the part of the gap that no effect explains; "" if there is none."""
    if diagnosis.verdict not in ("unknown", "named+unknown"):
        return ""
    gap = diagnosis.gap
    left = millimetres(max(gap.after_rmse_mm**2 - gap.noise_floor_mm**2, 0.0) ** 0.5)
    text = f"The best explanation leaves a gap of {left} above the noise, which none of the tried effects explains."
    if diagnosis.leftover_p is None:
        return text
    share_of = f"{100 * diagnosis.leftover_p:.0f} %"
    text += (
        f" On labelled logs of simulated cables, correct explanations leave as large a gap in {share_of} of the cases."
    )
    if diagnosis.effects:
        text += (
            f" Of the effects named on those logs together with an unknown cause, {share(BESIDE_UNKNOWN)} are causes; "
            "the others only resemble a cause that is not in the library."
        )
    return text


def ranking_note(diagnosis: CableDiagnosis) -> str:
    """Caption of the chart of the effects that were tried."""
    if any(ranked.probability is None for ranked in diagnosis.ranking):
        return (
            "Every effect tried in the forward search, in that order: the share of the squared error that it removes "
            "on held-out recordings when added to the effects kept before it. The error without any effect is 100 %. "
            "Negative: the effect increases the error. Not judged: its simulations failed in many windows."
        )
    note = "Every effect alone, the most probable first."
    shares = [ranked.held_out_shrinkage for ranked in diagnosis.ranking]
    if shares and max(shares) > shares[0] + _CONTRADICTS:
        note += (
            " Every motion has equal weight in the probability. The share is of the total squared error, in which one "
            "motion where the cable swings over can outweigh the others."
        )
    if len({effect.name for effect in diagnosis.effects}) > 1:
        note += " The cause named above is a set of effects; none of them is enough alone."
    return note


def how_far(diagnosis: CableDiagnosis) -> str:
    """How far the gap shrinks, by which effects, and on which episodes."""
    gap = diagnosis.gap
    added = listed(list(dict.fromkeys(effect_title(e.name) for e in diagnosis.effects))) or "the best explanation"
    if diagnosis.verdict == "none":
        text = "There is no gap above the noise to shrink."
    elif diagnosis.explained is None:
        text = "No effect was added to the simulator, so nothing shrinks."
    elif gap.shrinkage is None and gap.held_out_episodes:
        text = (
            "Even without the cause, the errors of the keypoints are within the noise, so there is no gap of theirs "
            "that could shrink: only the grippers' measured poses show the cause."
        )
    elif gap.shrinkage is None:
        text = (
            "The log holds one motion, and the fit used all of it. With no held-out motion, how far the gap shrinks is "
            f"unknown. In the fit itself, the error falls from {millimetres(gap.before_rmse_mm)} to "
            f"{millimetres(gap.after_rmse_mm)} with {added}."
        )
    else:
        held = [str(e) for e in gap.held_out_episodes]
        named = f"episode{'s' * (len(held) > 1)} {listed(held)}" if len(held) <= _LISTED else f"{len(held)} episodes"
        interval = ""
        if gap.shrinkage_ci90 is not None:
            interval = f" (90 % interval over episodes: {between(*gap.shrinkage_ci90)})"
        besides = " plus constant offsets of the markers" if diagnosis.log.in_space else ""
        text = (
            f"With {added} in the simulator, {share(gap.shrinkage)} of the squared gap above the noise goes "
            f"away{interval}, on {named}, each left out of the fit that predicts it. The error falls from "
            f"{millimetres(gap.before_rmse_mm)} to {millimetres(gap.after_rmse_mm)}; nothing can go below the noise of "
            f"{millimetres(gap.noise_floor_mm)}{besides}."
        )
    if gap.ahead_mm is not None:
        ahead = {name: millimetres(value) for name, value in gap.ahead_mm.items()}
        text += (
            f" Five seconds ahead of an observation, the nominal simulator is off by {ahead['nominal']}; with a ridge "
            f"residual, which models no cause, by {ahead['ridge']}"
        )
        text += f"; with {added} and no residual by {ahead['named']}." if diagnosis.explained is not None else "."
    return text


def nothing_next(diagnosis: CableDiagnosis) -> str:
    """Why no motion is recommended."""
    if diagnosis.log.in_space:
        return "No motion was evaluated: this version recommends motions only for cables on a table."
    settled = diagnosis.verdict in ("none", "named")
    return "No explanations are left to separate." if settled else "No motion of the library would help."


def rounds_table(diagnosis: CableDiagnosis) -> Table | None:
    """Table of what each recording added and the probabilities after it; None for a single recording."""
    if diagnosis.rounds is None:
        return None
    rounds = diagnosis.rounds.rounds
    leader, *others = rounds[0].nats
    head = (
        "recording",
        "episodes",
        *(f"nats for {explanation_title(leader)}, against {explanation_title(name)}" for name in others),
        *(f"probability of {explanation_title(name)} then" for name in (leader, *others)),
    )
    rows = [
        (
            one.name,
            str(one.episodes),
            *(f"{-one.nats[name]:+.1f}" for name in others),
            *(share(one.probability[name]) for name in (leader, *others)),
        )
        for one in rounds
    ]
    return "What each recording added", head, rows


def detail_tables(diagnosis: CableDiagnosis) -> list[Table]:
    """The tables under "Details"; those without rows are left out, except the regimes'."""
    where = diagnosis.where
    alone = all(r.probability is not None for r in diagnosis.ranking)
    tried = [
        (
            effect_title(r.name),
            EFFECTS.get(r.name, ""),
            *([share(r.probability)] if alone and r.probability is not None else []),
            *([] if alone else [r.outcome or ""]),
            share_removed(r),
            millimetres(r.leftover_mm),
        )
        for r in diagnosis.ranking
    ]
    regimes = [(name, millimetres(size)) for name, size in where.regimes.items()]
    regimes += [
        (f"time: {begin:g} to {end:g} s after the start", millimetres(where.horizons_mm[end]))
        for begin, end in itertools.pairwise([0.0, *where.horizons_mm])
    ]
    tables: list[Table] = [
        (
            f"All effects tried{' alone' if alone else ', in order, each added to those kept before it'}",
            ("effect", "what it is", "probability" if alone else "outcome", "share removed", "left"),
            tried,
        ),
        ("Gap above the noise by regime", ("regime", "gap"), regimes),
        (
            "Comparisons, tested over episodes",
            ("comparison", "ratio of the gaps", "p-value, corrected"),
            [(name, f"{ratio:.2f}", f"{p:.3f}") for name, (ratio, p) in where.contrasts.items()],
        ),
        (
            "Frames",
            ("an error that is constant in", "would explain"),
            [(name, share(part)) for name, part in where.frames.items()],
        ),
        (
            "What simpler rules would have named",
            ("rule", "would have named"),
            [(_RULES.get(rule, rule), effect_title(name)) for rule, name in diagnosis.baselines.items()],
        ),
    ]
    return [(title, head, rows) for title, head, rows in tables if rows or rows is regimes]


def record(diagnosis: CableDiagnosis) -> dict[str, str]:
    """Noise, source, time and settings."""
    settings = {
        name: value if isinstance(value, str) else json.dumps(value, default=str)
        for name, value in diagnosis.settings.items()
    }
    return {
        "noise of each keypoint [mm]": ", ".join(f"{v:.2f}" for v in diagnosis.noise_mm),
        "its correlation at 1, 2, ... samples": ", ".join(f"{v:.2f}" for v in diagnosis.noise_correlation) or "n/a",
        "source of the log": str(diagnosis.log.meta.get("source", "")),
        "run time": f"{diagnosis.seconds:.0f} s",
        **settings,
    }
