"""A diagnosis as one self-contained HTML page."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterator

import numpy as np

from cablejax.cable_file import cable_of_log
from cablejax.diagnose.belief import Calibration
from cablejax.diagnose.diagnosis import CableDiagnosis, NamedEffect, Verdict
from cablejax.diagnose.judgement import FAINT, effect_title, in_its_place, listed, share
from cablejax.diagnose.verdict_json import write_verdict
from cablejax.effects import OUTSIDE
from cablejax.gaplog import SIMULATED, write_gap_log
from cablejax.limits import counted
from cablejax.report import diagnosis_sections as sections
from cablejax.report.diagnosis_charts import ranking_figure, shrinkage_figure
from cablejax.report.diagnosis_figures import cable_figure, where_figure
from cablejax.report.effect_words import (
    between,
    effect_place,
    error_falls,
    explained_label,
    instruction,
    millimetres,
    parameter_title,
    quantity,
)
from cablejax.report.html import json_script, svg, write_html
from cablejax.report.motion_figures import motion_figure, write_motion_gif
from cablejax.report.spatial_figures import cable_still, files_figure, orbit_data, with_the_cause
from cablejax.whole_file import whole_file

PAGE = "report.html"
"""Name of the page in a diagnosis' folder."""
SIMULATIONS = "simulated.npz"
"""Name of the log with the simulated keypoints in a diagnosis' folder."""
_BADGES: dict[Verdict, tuple[str, str]] = {
    "none": ("none", "No gap found"),
    "named": ("named", "Cause named"),
    "ambiguous": ("ambiguous", "Cause narrowed down, not settled"),
    "named+unknown": ("partly", "Part of the cause named"),
    "unknown": ("unknown", "Cause unknown"),
}
INFORMING = {
    # which models: the words for all of them are the shortest
    **dict.fromkeys(
        ("stiffness_profile", "intrinsic_curvature", "gripper_rotation_offset", "gripper_compliance"), "a model"
    ),
    **dict.fromkeys(
        ("bending_stiffness", "table_friction", "linear_density"), "a conditioned model, such as gns-conditioned,"
    ),
}
"""Effects of which a model can be informed, see `control.shaping.knowing`, and which models can be."""
_DPI = 150
_SPACE_CAPTION = (
    "Up to five seconds of motion, simulated from two observed samples, in the files with the largest, median and "
    "smallest gaps. Drag to turn, scroll to zoom. The solid line is a fit that has not seen this file."
)
_WHERE_CAPTION = (
    "Top: the gap of each keypoint over the whole log. Below: each episode over time; darker means further above the "
    "noise. Black bars mark holds. The cable's own gap fades towards the grippers that hold it."
)
_FILES_CAPTION = (
    "Each column is a file, each row a keypoint; white lines separate recordings. The cable's own gap fades towards "
    "the grippers that hold it; a file that differs from its neighbours was recorded with something changed."
)


def write_diagnosis_page(diagnosis: CableDiagnosis, out: str | os.PathLike[str]) -> pathlib.Path:
    """Writes `report.html`, `verdict.json`, `simulated.npz` and the figures as PNG into a folder.

    `simulated.npz` is the log with the simulated keypoints, see `read_simulated`. The figures are `cable.png`,
    `where.png`, `shrinkage.png`, and, where effects were tried, `ranking.png`. Where there is a motion to record next,
    `next_motion.gif` shows it.

    Returns:
        The page's path.
    """
    out = pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    write_verdict(out / "verdict.json", diagnosis)
    simulated = {name: getattr(diagnosis, name) for name in SIMULATED}
    given = {name: points for name, points in simulated.items() if points is not None}
    write_gap_log(out / SIMULATIONS, diagnosis.log, overwrite=True, simulated=given)
    space, following = diagnosis.log.in_space, diagnosis.next_motion
    drawn = {
        "cable": cable_still(diagnosis) if space else cable_figure(diagnosis),
        "where": files_figure(diagnosis) if space else where_figure(diagnosis),
        "ranking": ranking_figure(diagnosis),
        "shrinkage": shrinkage_figure(diagnosis),
        "motion": motion_figure(following),
    }
    inline = {}
    for name, figure in drawn.items():
        inline[name] = "" if figure is None else svg(figure, name)
        picture = out / f"{name}.png"
        if figure is not None and name != "motion":
            # laid out already: to find room for all words takes longer than to draw them
            figure.set_layout_engine("none")
            with whole_file(picture) as stream:
                figure.savefig(stream, format="png", dpi=_DPI)
        else:
            # none of an earlier diagnosis next to this page
            picture.unlink(missing_ok=True)
    preview = out / "next_motion.gif"
    if following is None:
        preview.unlink(missing_ok=True)
    else:
        write_motion_gif(preview, following)
    (kind, badge), orbit = _BADGES[diagnosis.verdict], None
    if space:
        label = "" if with_the_cause(diagnosis) is None else explained_label(diagnosis)
        orbit = {"data": json_script(orbit_data(diagnosis)), "explained": label}
    path = out / PAGE
    named, addable = {effect.name for effect in diagnosis.effects}, sections.addable(diagnosis) and not space
    simulated = named | {effect.name for draw in diagnosis.posterior for effect in draw}
    write_html(
        path,
        "diagnosis.html",
        title=f"Diagnosis: {badge}",
        kind=kind,
        badge=badge,
        diagnosis=diagnosis,
        lead=_lead(diagnosis),
        cards=_cards(diagnosis),
        works=_works(diagnosis),
        pictures=inline,
        orbit=orbit,
        trainable=addable and simulated.isdisjoint(OUTSIDE) and cable_of_log(diagnosis.log).marks is None,
        informs=min((INFORMING[name] for name in named & INFORMING.keys()), key=len, default="") if addable else "",
        cable_caption=_SPACE_CAPTION if space else _cable_caption(diagnosis),
        where_caption=_FILES_CAPTION if space else _WHERE_CAPTION,
        effects=sections.named_effects(diagnosis),
        quantities=sections.quantities(diagnosis),
        alike=sections.alike(diagnosis),
        under_laws=sections.under_other_laws(diagnosis),
        faint_below=FAINT,
        left=sections.what_is_left(diagnosis),
        rounds=sections.rounds_table(diagnosis),
        ranking_note=sections.ranking_note(diagnosis),
        far=sections.how_far(diagnosis),
        following=following,
        nothing_next=sections.nothing_next(diagnosis),
        instruction="" if following is None else instruction(following),
        tables=sections.detail_tables(diagnosis),
        record=sections.record(diagnosis),
    )
    return path


def _lead(diagnosis: CableDiagnosis) -> str:
    """The log and its gap in one line."""
    log, gap = diagnosis.log, diagnosis.gap
    return (
        f"{counted(len(log.episode_length), 'episode')}, {log.intervals.sum():.0f} s, {log.keypoints.shape[2]} "
        f"keypoints. The simulator misses the recorded cable by {millimetres(gap.before_rmse_mm)}; the recording's own "
        f"{_noise(diagnosis)}."
    )


def _works(diagnosis: CableDiagnosis) -> str:
    """What shows that the verdict holds, or what it lacks, in a sentence or two."""
    gap, limits = diagnosis.gap, len(diagnosis.caveats)
    if diagnosis.verdict == "none":
        said = "The simulated cable moves like the recorded one, to within the noise and the simulator's own error."
    elif diagnosis.effects and gap.shrinkage is not None:
        said = f"With the cause, the gap shrinks by {share(gap.shrinkage)} on episodes that no fit has seen."
    elif diagnosis.effects and gap.held_out_episodes:
        said = "The keypoints cannot show it, since even without the cause they are within the noise: the poses do."
    elif diagnosis.effects:
        said = "This log cannot show it, since no motion was held out of the fit: record a second motion."
    elif diagnosis.undecided:
        said = "Not on this log: effects of the library would explain it, but it shows too little to name one."
    else:
        said = "Not on this log: no effect of the library explains enough of the gap, so none is named."
    return f"{said} This verdict has {counted(limits, 'limit')}: see the end of the page." if limits else said


def _cards(diagnosis: CableDiagnosis) -> Iterator[tuple[str, str, str]]:
    """Heading, text and note of each card."""
    gap = diagnosis.gap
    if diagnosis.effects:
        alike = (in_its_place(e.name, diagnosis.equivalent, diagnosis.effects) for e in diagnosis.effects)
        names = listed(list(dict.fromkeys(listed([*map(effect_title, names)], "or") for names in alike)))
        title = "Part of the cause" if diagnosis.verdict == "named+unknown" else "Cause"
        yield (title, names, _chance(diagnosis))
        places = [p for p in (effect_place(e) for e in diagnosis.effects) if p]
        yield ("Place of the cause", listed(places) if places else "not in one place", _peak(diagnosis))
    elif diagnosis.verdict == "none":
        least = _least(diagnosis)
        where = " in a calm motion" if gap.before_rmse_mm > least else ""
        yield ("Cause", "none needed", f"a gap of {millimetres(least)} would have shown{where}")
    else:
        tried = [r for r in diagnosis.ranking if np.isfinite(r.held_out_shrinkage)]
        best = max(tried, key=lambda r: (r.probability or 0.0, r.held_out_shrinkage), default=None)
        enough = "but the log shows too little of it" if diagnosis.undecided else "which is not enough"
        note = "" if best is None else f"closest: {effect_title(best.name)}, {enough}"
        yield ("Cause", "unknown", note)
        yield ("Place of the cause", "unknown", _peak(diagnosis))
    if gap.shrinkage is not None and diagnosis.explained is not None:
        interval = "" if gap.shrinkage_ci90 is None else f"90 % interval {between(*gap.shrinkage_ci90)}, "
        yield ("The gap shrinks by", share(gap.shrinkage), f"{interval}on episodes that no fit has seen")
        yield ("Error", error_falls(gap), _noise(diagnosis))
    else:
        yield ("Error", millimetres(gap.before_rmse_mm), _noise(diagnosis))


def _noise(diagnosis: CableDiagnosis) -> str:
    """The noise, and what it leaves out: in space it is only what changes between samples."""
    offset = diagnosis.quantities.get("constant_offset_m")
    besides = "" if offset is None else f", constant offsets of keypoints {millimetres(1e3 * offset.value)}"
    return f"noise {millimetres(diagnosis.gap.noise_floor_mm)}{besides}"


def _chance(diagnosis: CableDiagnosis) -> str:
    """Probability of the named effects, where computed, and strength of the first one."""
    chances = [e.probability for e in diagnosis.effects if e.probability is not None]
    strength = _most_telling(diagnosis.effects[0])
    if not chances:
        return strength
    if diagnosis.equivalent:
        return f"most probable: {effect_title(diagnosis.effects[0].name)}, {share(chances[0])}"
    return "; ".join(part for part in (f"probability {share(min(chances))}", strength) if part)


def _least(diagnosis: CableDiagnosis) -> float:
    """The gap [mm] from which on the verdict would not have been "none"."""
    if diagnosis.log.in_space:
        return diagnosis.where.smallest_mm
    calibration = Calibration(**diagnosis.settings.get("calibration", {}))
    noise = float(np.sqrt(np.mean(diagnosis.noise_mm**2)))
    return max(diagnosis.where.smallest_mm, 1e3 * calibration.smallest_gap(1e-3 * noise))


def _peak(diagnosis: CableDiagnosis) -> str:
    profile = diagnosis.where.along_cable_mm
    peak = int(np.nanargmax(profile))
    return f"the gap peaks at {diagnosis.log.meta['keypoint_arclength_m'][peak]:.2f} m, {millimetres(profile[peak])}"


def _most_telling(effect: NamedEffect) -> str:
    """The parameter that says how strong an effect is, which is neither a place nor a choice."""
    places = {"centre_m", "width_m", "x_m", "y_m", "gripper", "index", "direction_rad"}
    for name, estimate in effect.parameters.items():
        if name not in places and estimate.ci90 is not None:
            return f"{parameter_title(name)} {quantity(estimate.value, estimate.unit, estimate.ci90, interval=False)}"
    return ""


def _cable_caption(diagnosis: CableDiagnosis) -> str:
    parts = ["The moment at which observation and simulator are furthest apart, seen from above."]
    if any(e.location.get("along_cable_m") or e.location.get("table_m") for e in diagnosis.effects):
        parts.append("Shaded blue: where the named effect sits.")
    if diagnosis.explained is not None:
        parts.append("The solid line comes from a fit that has not seen this episode.")
    return " ".join(parts)
