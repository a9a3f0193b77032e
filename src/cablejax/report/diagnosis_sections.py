"""The sections of a diagnosis' page, in HTML: which effect, how far, what next, and everything in detail."""

from __future__ import annotations

import html
import itertools
import json
from collections.abc import Sequence

from cablejax.diagnose.diagnosis import CableDiagnosis, NamedEffect
from cablejax.diagnose.judgement import FAINT, look_alikes
from cablejax.report.effect_words import (
    EFFECTS,
    MOTIONS,
    between,
    effect_place,
    effect_title,
    listed,
    millimetres,
    parameter_title,
    quantity,
    share,
)

SEPARABLE = 0.3
"""A motion on which two explanations differ by less than this many noise units does not separate them."""

# More episodes than this are counted, not listed.
_LISTED = 8

_RULES = {
    "lowest_cost": "best fit to the log itself",
    "bic": "best fit with Schwarz's penalty",
    "sparse_regression": "best template without a fit",
}


def which_section(diagnosis: CableDiagnosis, ranking: str) -> str:
    """HTML: the named effects with their parameters, and the look-alikes; `ranking` is the figure."""
    parts = []
    if diagnosis.verdict == "none":
        parts.append("<p>There is no gap to explain, so no effect is named.</p>")
    for effect in diagnosis.effects:
        rows = "".join(
            f"<tr><td>{html.escape(parameter_title(name))}</td>"
            f"<td>{html.escape(quantity(estimate.value, estimate.unit, estimate.ci90))}</td></tr>"
            for name, estimate in effect.parameters.items()
        )
        meaning = EFFECTS.get(effect.name, "an effect of your own")
        where = effect_place(effect)
        parts.append(
            f"<p><b>{html.escape(effect_title(effect.name).capitalize())}</b>: {html.escape(meaning)}"
            f"{', ' + html.escape(where) if where else ''}.{_probability(effect)}</p>"
            f'<div class="scroll"><table><thead><tr><th>parameter</th><th>estimate (90 % interval)</th></tr></thead>'
            f"<tbody>{rows}</tbody></table></div>"
        )
    for group in diagnosis.equivalent:
        likely, faint = (
            [f"<b>{html.escape(effect_title(name))}</b>" for name in members]
            for members in look_alikes(group, diagnosis.effects, diagnosis.ranking)
        )
        if len(likely) > 1:
            parts.append(
                f"<p>{listed(likely)} are indistinguishable on this log: each explains the gap as well, within the "
                "errors of noise and simulator.</p>"
            )
        if faint:
            parts.append(
                f"<p>{listed(faint)} would leave as little of the gap, at a probability below {share(FAINT)}: a "
                "likelihood is that sure only if every law is exact.</p>"
            )
    if diagnosis.verdict in ("unknown", "named+unknown"):
        left = millimetres(_left(diagnosis))
        parts.append(
            f"<p>What is left after the best explanation, {left} above the noise, has no cause in the library."
            f"{_as_much(diagnosis.leftover_p)}</p>"
        )
    if ranking:
        parts.append(f"<figure>{ranking}<figcaption>{_ranking_note(diagnosis)}</figcaption></figure>")
    return "\n".join(parts)


def in_space(diagnosis: CableDiagnosis) -> bool:
    """Whether the cable hangs in space, rather than lying on a table."""
    return diagnosis.log.keypoints.shape[-1] == 3


def _probability(effect: NamedEffect) -> str:
    return "" if effect.probability is None else f" Probability {share(effect.probability)}."


def _ranking_note(diagnosis: CableDiagnosis) -> str:
    if any(ranked.probability is None for ranked in diagnosis.ranking):
        return (
            "Every effect tried in the forward search: what it takes away on unseen recordings when it joins those "
            "kept before it, as a share of the squared error without any effect. Negative: it makes them worse."
        )
    note = "Every effect alone, the most probable first."
    if len(diagnosis.effects) > 1:
        note += " The cause named above is a set; alone, none of its members is enough."
    return note


def _left(diagnosis: CableDiagnosis) -> float:
    gap = diagnosis.gap
    return max(gap.after_rmse_mm**2 - gap.noise_floor_mm**2, 0.0) ** 0.5


def far_section(diagnosis: CableDiagnosis, picture: str) -> str:
    """HTML: how far the gap shrinks with the named effects; `picture` is the figure."""
    gap = diagnosis.gap
    added = listed([effect_title(e.name) for e in diagnosis.effects]) or "the best explanation"
    if diagnosis.verdict == "none":
        text = "There is no gap above the noise that could shrink."
    elif diagnosis.explained is None:
        text = "Nothing was put into the simulator, so nothing shrinks."
    elif gap.shrinkage is None:
        text = (
            "The log holds one motion, and all of it was fitted: there is nothing to check on, so how far the gap "
            f"shrinks is not known. In the fit itself, the error falls from {millimetres(gap.before_rmse_mm)} to "
            f"{millimetres(gap.after_rmse_mm)} with {added}."
        )
    else:
        held = [str(e + 1) for e in gap.held_out_episodes]
        word = "episode" if len(held) == 1 else "episodes"
        named = f"{word} {listed(held)}" if len(held) <= _LISTED else f"{len(held)} {word}"
        interval = ""
        if gap.shrinkage_ci90 is not None:
            interval = f" (90 % interval over episodes: {between(*gap.shrinkage_ci90)})"
        besides = ", to which constant offsets of the markers add" if in_space(diagnosis) else ""
        text = (
            f"With {added} in the simulator, {share(gap.shrinkage)} of the squared gap above the noise goes "
            f"away{interval}, on {named}, each left out of the fit that predicts it. The error falls from "
            f"{millimetres(gap.before_rmse_mm)} to {millimetres(gap.after_rmse_mm)}; nothing can go below the noise of "
            f"{millimetres(gap.noise_floor_mm)}{besides}."
        )
    if gap.ahead_mm is not None:
        ahead = {name: millimetres(value) for name, value in gap.ahead_mm.items()}
        text += (
            f" Five seconds ahead of an observation, the simulator as believed is off by {ahead['nominal']}; "
            f"with an online ridge residual, which knows no cause, by {ahead['ridge']}"
        )
        text += f"; with {added} and no residual by {ahead['named']}." if diagnosis.explained is not None else "."
    caption = "Root mean square per coordinate. A prediction from an observation inherits its noise."
    return f"<p>{html.escape(text)}</p>\n<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def next_section(diagnosis: CableDiagnosis, picture: str) -> str:
    """HTML: the motion to record next and what it would separate; `picture` is the figure."""
    following = diagnosis.next_motion
    if following is None:
        if in_space(diagnosis):
            return "<p>No motion was evaluated: that is done for cables on a table only.</p>"
        settled = diagnosis.verdict in ("none", "named")
        words = "No explanations are left to separate." if settled else "No motion of the library would help."
        return f"<p>{words}</p>"
    motion = f"<b>{html.escape(effect_title(following.motion))}</b>"
    instruction = html.escape(MOTIONS.get(following.motion, ""))
    if following.separates:
        one, other = (f"<b>{html.escape(_explanation(name))}</b>" for name in following.separates)
        if following.separation < SEPARABLE:
            text = (
                f"No safe motion separates {one} from {other}, the two most probable explanations: on the best, "
                f"{motion}, they differ by {following.separation:.2g} of the noise. Measure one of them by other means."
            )
        else:
            text = (
                f"Record {motion}. {instruction} It separates {one} from {other}, the two most probable explanations: "
                f"there they differ by {following.separation:.2g} times the noise."
            )
    else:
        text = f"Record {motion}: it sharpens the parameters most. {instruction}"
    return f"<p>{text}</p>\n<figure>{picture}<figcaption>Top: the motion, seen from above.</figcaption></figure>"


def _explanation(names: str) -> str:
    return listed([effect_title(name) for name in names.split(" + ")])


def limits_section(diagnosis: CableDiagnosis) -> str:
    """HTML: the caveats, or nothing where there are none."""
    if not diagnosis.caveats:
        return ""
    rows = "".join(f"<li>{html.escape(caveat)}</li>" for caveat in diagnosis.caveats)
    return f'<h2>What limits this verdict</h2>\n<ul class="limits">{rows}</ul>'


def details_section(diagnosis: CableDiagnosis) -> str:
    """HTML: every effect tried, and the gap in numbers."""
    where = diagnosis.where
    alone = all(r.probability is not None for r in diagnosis.ranking)
    tried = _table(
        ("effect", "what it is", *(["probability"] if alone else []), "share taken away", "left"),
        [
            (
                effect_title(r.name),
                EFFECTS.get(r.name, ""),
                *([share(r.probability)] if alone and r.probability is not None else []),
                share(r.held_out_shrinkage),
                millimetres(r.leftover_mm),
            )
            for r in diagnosis.ranking
        ],
    )
    regimes = _table(
        ("regime", "gap"),
        [(name, millimetres(size)) for name, size in where.regimes.items()]
        + [
            (f"time: {begin:g} to {end:g} s after the start", millimetres(where.horizons_mm[end]))
            for begin, end in itertools.pairwise([0.0, *where.horizons_mm])
        ],
    )
    contrasts = _table(
        ("comparison", "ratio of the gaps", "p-value, corrected"),
        [(name, f"{ratio:.2f}", f"{p:.3f}") for name, (ratio, p) in where.contrasts.items()],
    )
    frames = _table(
        ("an error that is constant in", "would explain"),
        [(name, share(part)) for name, part in where.frames.items()],
    )
    rules = _table(
        ("rule", "would have named"),
        [(_RULES.get(rule, rule), effect_title(name)) for rule, name in diagnosis.baselines.items()],
    )
    noise = ", ".join(f"{v:.2f}" for v in diagnosis.noise_mm)
    lags = ", ".join(f"{v:.2f}" for v in diagnosis.noise_correlation)
    facts = {
        "noise of each keypoint [mm]": noise,
        "its correlation at 1, 2, ... samples": lags or "n/a",
        "source of the log": str(diagnosis.log.meta.get("source", "")),
        "run time": f"{diagnosis.seconds:.0f} s",
        **{
            name: value if isinstance(value, str) else json.dumps(value, default=str)
            for name, value in diagnosis.settings.items()
        },
    }
    rows = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in facts.items())
    return (
        '<div class="details">'
        + (
            f"<h3>All effects tried{' alone' if alone else ', each on top of those kept before it'}</h3>{tried}"
            if diagnosis.ranking
            else ""
        )
        + f"<h3>Gap above the noise by regime</h3>{regimes}"
        + (f"<h3>Comparisons, tested over episodes</h3>{contrasts}" if where.contrasts else "")
        + (f"<h3>Frames</h3>{frames}" if where.frames else "")
        + (f"<h3>What simpler rules would have named</h3>{rules}" if diagnosis.baselines else "")
        + f"<h3>Record</h3><dl>{rows}</dl></div>"
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _as_much(p: float | None) -> str:
    if p is None:
        return ""
    return f" On labelled logs of simulated cables, right explanations leave as much in {100 * p:.0f} % of the cases."
