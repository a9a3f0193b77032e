"""A diagnosis as one HTML page that needs nothing else, for an engineer with two minutes."""

from __future__ import annotations

import html
import importlib.resources
import json
import os
import pathlib
import string
from collections.abc import Sequence

from cablejax.diagnose.diagnosis import Diagnosis, NamedEffect, Verdict
from cablejax.diagnose.verdict_json import write_verdict
from cablejax.report import diagnosis_figures as figures
from cablejax.report.effect_words import (
    EFFECTS,
    MOTIONS,
    effect_title,
    listed,
    millimetres,
    parameter_title,
    place,
    quantity,
)
from cablejax.report.page import svg

PAGE = "diagnosis.html"
SEPARABLE = 0.3
"""A motion on which two explanations differ by less than this many noise units does not tell them apart."""

_BADGES: dict[Verdict, tuple[str, str]] = {
    "none": ("none", "No gap found"),
    "named": ("named", "Cause named"),
    "ambiguous": ("ambiguous", "Cause narrowed down, not settled"),
    "named+unknown": ("partly", "Part of the cause named"),
    "unknown": ("unknown", "Cause not in the library"),
}
_DPI = 150


def write_diagnosis_page(diagnosis: Diagnosis, out: str | os.PathLike[str]) -> pathlib.Path:
    """Writes `diagnosis.html`, `verdict.json` and the figures as PNG into a folder, and returns the page's path.

    The figures are `cable.png`, `where.png`, `shrinkage.png`, and, where effects were tried, `ranking.png`.
    """
    out = pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    write_verdict(out / "verdict.json", diagnosis)
    drawn = {
        "cable": figures.cable_figure(diagnosis),
        "where": figures.where_figure(diagnosis),
        "ranking": figures.ranking_figure(diagnosis),
        "shrinkage": figures.shrinkage_figure(diagnosis),
        "motion": figures.motion_figure(diagnosis),
    }
    inline = {}
    for name, figure in drawn.items():
        inline[name] = "" if figure is None else svg(figure, name)
        picture = out / f"{name}.png"
        if figure is not None and name != "motion":
            figure.savefig(picture, dpi=_DPI)
        else:
            # none of an earlier diagnosis beside this page
            picture.unlink(missing_ok=True)
    kind, badge = _BADGES[diagnosis.verdict]
    here = importlib.resources.files("cablejax.report")
    css = "\n".join((here / name).read_text(encoding="utf-8") for name in ("page.css", "diagnosis.css"))
    page = string.Template((here / "diagnosis.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"Diagnosis: {badge}"),
        css=css,
        kind=kind,
        badge=badge,
        headline=html.escape(diagnosis.sentence),
        lead=_lead(diagnosis),
        cards="\n".join(_cards(diagnosis)),
        cable=inline["cable"],
        cable_caption=_cable_caption(diagnosis),
        where="\n".join(f"<li>{html.escape(sentence)}</li>" for sentence in diagnosis.where.sentences),
        where_figure=inline["where"],
        where_caption=(
            "Top: the gap of each keypoint over the whole log. Below: each episode over time; the darker, the further "
            "beyond the noise. Black bars mark holds. The gap is always small at the grippers, which hold the cable."
        ),
        which=_which(diagnosis, inline["ranking"]),
        far=_far(diagnosis, inline["shrinkage"]),
        next=_next(diagnosis, inline["motion"]),
        caveats=_limits(diagnosis),
        details=_details(diagnosis),
    )
    path = out / PAGE
    path.write_text(page, encoding="utf-8")
    return path


def _lead(diagnosis: Diagnosis) -> str:
    """What was looked at, and the gap in one line."""
    log, gap = diagnosis.log, diagnosis.gap
    seconds = sum(float(t[n - 1] - t[0]) for t, n in zip(log.time, log.episode_length, strict=True))
    episodes = len(log.episode_length)
    text = (
        f"{episodes} episode{'' if episodes == 1 else 's'}, {seconds:.0f} s, {log.keypoints.shape[2]} keypoints. "
        f"The simulator misses the recorded cable by {millimetres(gap.before_rmse_mm)}; the recording's noise alone is "
        f"{millimetres(gap.noise_floor_mm)}."
    )
    return html.escape(text)


def _cards(diagnosis: Diagnosis):
    gap = diagnosis.gap
    if diagnosis.effects:
        names = listed([listed(_alike(diagnosis, e), "or") for e in diagnosis.effects])
        chance = min(e.probability for e in diagnosis.effects)
        if diagnosis.equivalent:
            note = (
                f"most probable: {effect_title(diagnosis.effects[0].name)}, {_share(diagnosis.effects[0].probability)}"
            )
        else:
            note = f"probability {_share(chance)}" + _most_telling(diagnosis.effects[0])
        yield _card("Cause", names, note)
        places = [p for p in (_place_of(e) for e in diagnosis.effects) if p]
        yield _card("Place of the cause", listed(places) if places else "no single place", _peak(diagnosis))
    elif diagnosis.verdict == "none":
        least = millimetres(max(diagnosis.where.smallest_mm, 0.01))
        yield _card("Cause", "none needed", f"a gap of {least} would have shown")
    else:
        best = diagnosis.ranking[0] if diagnosis.ranking else None
        note = "" if best is None else f"closest: {effect_title(best.name)}, which is not enough"
        yield _card("Cause", "not in the library", note)
        yield _card("Place of the cause", "unknown", _peak(diagnosis))
    if gap.shrinkage is not None and diagnosis.explained is not None:
        interval = "" if gap.shrinkage_ci90 is None else f"90 % interval {_between(*gap.shrinkage_ci90)}, "
        seen = "on episodes that no fit has seen" if gap.held_out_episodes else "on the very episode that was fitted"
        yield _card("The gap shrinks by", _share(gap.shrinkage), interval + seen)
        yield _card(
            "Error",
            f"{gap.before_rmse_mm:.1f} → {millimetres(gap.after_rmse_mm)}",
            f"noise {millimetres(gap.noise_floor_mm)}",
        )
    else:
        yield _card("Error", millimetres(gap.before_rmse_mm), f"noise {millimetres(gap.noise_floor_mm)}")


def _peak(diagnosis: Diagnosis) -> str:
    profile = diagnosis.where.along_cable_mm
    peak = int(profile.argmax())
    return f"the gap peaks at {diagnosis.log.meta['keypoint_arclength_m'][peak]:.2f} m, {millimetres(profile[peak])}"


def _alike(diagnosis: Diagnosis, effect: NamedEffect) -> list[str]:
    """The effect and those that cannot be told from it, in words."""
    group = next((g for g in diagnosis.equivalent if effect.name in g), ())
    return [effect_title(effect.name), *(effect_title(name) for name in group if name != effect.name)]


def _card(title: str, text: str, note: str = "") -> str:
    small = f"<small>{html.escape(note)}</small>" if note else ""
    return f'<div class="card"><h3>{title}</h3><p>{html.escape(text)}</p>{small}</div>'


def _most_telling(effect: NamedEffect) -> str:
    """The parameter that says how strong an effect is, which is neither a place nor a choice."""
    places = {"centre_m", "width_m", "x_m", "y_m", "gripper", "index", "direction_rad"}
    for name, estimate in effect.parameters.items():
        if name not in places and estimate.ci90 is not None:
            return f"; {parameter_title(name)} {quantity(estimate.value, estimate.unit, estimate.ci90, interval=False)}"
    return ""


def _place_of(effect: NamedEffect) -> str:
    gripper = effect.parameters.get("gripper")
    return place(effect.location, None if gripper is None else gripper.value)


def _cable_caption(diagnosis: Diagnosis) -> str:
    parts = ["The moment at which observation and simulator are furthest apart, seen from above."]
    if any(e.location.get("along_cable_m") or e.location.get("table_m") for e in diagnosis.effects):
        parts.append("Shaded blue: where the named effect sits.")
    if diagnosis.explained is not None:
        parts.append("The solid line comes from a fit that has not seen this episode.")
    return html.escape(" ".join(parts))


def _which(diagnosis: Diagnosis, ranking: str) -> str:
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
        where = _place_of(effect)
        parts.append(
            f"<p><b>{html.escape(effect_title(effect.name).capitalize())}</b>: {html.escape(meaning)}"
            f"{', ' + html.escape(where) if where else ''}. Probability {_share(effect.probability)}.</p>"
            f'<div class="scroll"><table><thead><tr><th>parameter</th><th>estimate (90 % interval)</th></tr></thead>'
            f"<tbody>{rows}</tbody></table></div>"
        )
    for group in diagnosis.equivalent:
        names = listed([f"<b>{html.escape(effect_title(name))}</b>" for name in group])
        parts.append(
            f"<p>This log cannot tell {names} apart: each explains the gap as well, within what noise and simulator "
            "allow.</p>"
        )
    if diagnosis.verdict in ("unknown", "named+unknown"):
        left = millimetres(_left(diagnosis))
        parts.append(
            f"<p>What is left after the best explanation, {left} above the noise, has none in the library.</p>"
        )
    if ranking:
        note = "Every effect alone, the most probable first."
        if len(diagnosis.effects) > 1:
            note += " The cause named above is a set; alone, none of its members is enough."
        parts.append(f"<figure>{ranking}<figcaption>{note}</figcaption></figure>")
    return "\n".join(parts)


def _left(diagnosis: Diagnosis) -> float:
    gap = diagnosis.gap
    return max(gap.after_rmse_mm**2 - gap.noise_floor_mm**2, 0.0) ** 0.5


def _far(diagnosis: Diagnosis, picture: str) -> str:
    gap = diagnosis.gap
    if gap.shrinkage is None:
        text = "There is no gap above the noise that could shrink."
    elif diagnosis.explained is None:
        text = "Nothing was put into the simulator, so nothing shrinks."
    else:
        held = [str(e + 1) for e in gap.held_out_episodes]
        word = "episode" if len(held) == 1 else "episodes"
        seen = (
            f"on {word} {listed(held)}, each left out of the fit that predicts it"
            if held
            else "on the very episode that was fitted: there was no other to check on"
        )
        interval = ""
        if gap.shrinkage_ci90 is not None:
            interval = f" (90 % interval over episodes: {_between(*gap.shrinkage_ci90)})"
        added = listed([effect_title(e.name) for e in diagnosis.effects]) or "the best explanation"
        text = (
            f"With {added} in the simulator, {_share(gap.shrinkage)} of the squared gap above the noise goes "
            f"away{interval}, {seen}. The error falls from {millimetres(gap.before_rmse_mm)} to "
            f"{millimetres(gap.after_rmse_mm)}; nothing can go below the noise of {millimetres(gap.noise_floor_mm)}."
        )
    if gap.ahead_mm is not None:
        ahead = {name: millimetres(value) for name, value in gap.ahead_mm.items()}
        text += (
            f" Predicting five seconds ahead of the last observation, the simulator as believed is off by "
            f"{ahead['nominal']}, with an online ridge residual, which knows no cause, by {ahead['ridge']}, with the named "
            f"cause and no residual by {ahead['named']}."
        )
    caption = "Root mean square per coordinate, open loop from the start of each episode."
    return f"<p>{html.escape(text)}</p>\n<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _next(diagnosis: Diagnosis, picture: str) -> str:
    following = diagnosis.next_motion
    if following is None:
        words = (
            "No further motion is needed." if diagnosis.verdict == "none" else "No motion of the library would help."
        )
        return f"<p>{words}</p>"
    motion = f"<b>{html.escape(effect_title(following.motion))}</b>"
    instruction = html.escape(MOTIONS.get(following.motion, ""))
    if following.separates:
        names = listed([f"<b>{html.escape(_explanation(name))}</b>" for name in following.separates], "and")
        if following.separation < SEPARABLE:
            text = (
                f"None of the safe motions tells {names} apart: on the best of them, {motion}, their predictions "
                f"differ by {following.separation:.2g} of the noise. Measure one of them by other means."
            )
        else:
            text = (
                f"Record {motion}. {instruction} The two most probable explanations, {names}, differ there by "
                f"{following.separation:.2g} times the noise."
            )
    else:
        text = f"Record {motion}: it sharpens the parameters most. {instruction}"
    return f"<p>{text}</p>\n<figure>{picture}<figcaption>Top: the motion, seen from above.</figcaption></figure>"


def _explanation(names: str) -> str:
    return effect_title(names).replace(" + ", " with ")


def _limits(diagnosis: Diagnosis) -> str:
    if not diagnosis.caveats:
        return ""
    rows = "".join(f"<li>{html.escape(caveat)}</li>" for caveat in diagnosis.caveats)
    return f'<h2>What limits this verdict</h2>\n<ul class="limits">{rows}</ul>'


def _details(diagnosis: Diagnosis) -> str:
    where = diagnosis.where
    tried = _table(
        ("effect", "what it is", "probability", "share taken away", "left"),
        [
            (
                effect_title(r.name),
                EFFECTS.get(r.name, ""),
                _share(r.probability),
                _share(r.held_out_shrinkage),
                millimetres(r.leftover_mm),
            )
            for r in diagnosis.ranking
        ],
    )
    regimes = _table(
        ("regime", "gap"),
        [(name, millimetres(size)) for name, size in where.regimes.items()]
        + [(f"within {seconds:g} s of the start", millimetres(size)) for seconds, size in where.horizons_mm.items()],
    )
    contrasts = _table(
        ("comparison", "ratio of the gaps", "p-value, corrected"),
        [(name, f"{ratio:.2f}", f"{p:.3f}") for name, (ratio, p) in where.contrasts.items()],
    )
    frames = _table(
        ("an error that is constant in", "would explain"),
        [(name, _share(share)) for name, share in where.frames.items()],
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
        + (f"<h3>All effects tried alone</h3>{tried}" if diagnosis.ranking else "")
        + f"<h3>Gap above the noise by regime</h3>{regimes}"
        + (f"<h3>Comparisons, tested over episodes</h3>{contrasts}" if where.contrasts else "")
        + (f"<h3>Frames</h3>{frames}" if where.frames else "")
        + f"<h3>Record</h3><dl>{rows}</dl></div>"
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _share(value: float) -> str:
    """A share in per cent; never 0 or 100 where it is only close."""
    percent = 100 * value
    if percent >= 99.5:
        return "> 99 %"
    if 0 < percent < 0.5:
        return "< 1 %"
    return f"{percent:.0f} %"


def _between(low: float, high: float) -> str:
    """An interval of shares, "88 % to 93 %"; a single one where both ends read the same."""
    ends = _share(low), _share(high)
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"
