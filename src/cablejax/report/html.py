"""Fills this folder's HTML templates: self-contained pages without network or further files."""

from __future__ import annotations

import functools
import io
import json
import os
import pathlib
import re
from typing import Any

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from cablejax.diagnose.judgement import share
from cablejax.report.effect_words import explanation_title
from cablejax.report.style import LIGHT
from cablejax.whole_file import whole_file


def write_html(path: str | os.PathLike[str], template: str, **values: Any) -> None:
    """Writes a template filled in; strings are escaped unless they are `Markup`."""
    page = _environment().get_template(template).render(**values)
    with whole_file(pathlib.Path(path)) as stream:
        stream.write(page.encode(errors="replace"))


@functools.cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("cablejax.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"words": explanation_title, "share": share}
    return environment


def json_script(value: Any) -> Markup:
    """JSON for a script element, without a tag or a comment that a string could open or close there."""
    return Markup(json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))


def svg(figure: Figure, name: str) -> Markup:
    """A figure as an inline SVG element in the page's own colours; `name` keeps its ids apart from those of others."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # As wide as the page, but a figure of one panel not blown up.
    width = figure.get_size_inches()[0]
    text = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', f'style="max-width: {1.4 * width:.1f}in"', text, count=1)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r'xlink:href="#', f'xlink:href="#{name}-', text)
    for role in ("ink", "muted", "faint", "gripper", "target", "residual", "direct"):
        text = re.sub(getattr(LIGHT, role), f"var(--{role})", text, flags=re.IGNORECASE)
    return Markup(text)
