"""Pages of results in Markdown, and their tables."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest

from cablejax.provenance import machine, versions
from cablejax.text_file import markdown_table as markdown_table


def share(of: Sequence[bool]) -> list[str]:
    """Cells of a table: how many of how many, and the share with its exact 95 % interval."""
    if not len(of):
        return ["0 of 0", ""]
    low, high = binomtest(int(np.sum(of)), len(of)).proportion_ci()
    return [f"{np.sum(of)} of {len(of)}", f"{100 * np.mean(of):.0f} % ({100 * low:.0f} to {100 * high:.0f})"]


def page_of_results(title: str, made_by: str, lines: Sequence[str], *, made_on: str | None = None) -> str:
    """A page of results.

    Args:
        title: its first line.
        made_by: the command that makes it, in backticks, and whatever else had to run.
        lines: of Markdown, all that follows the head.
        made_on: versions and machine, see `rows.made_on`; by default those of this process.
    """
    made_on = f"{versions()}; {machine()}." if made_on is None else made_on
    return "\n".join([f"# {title}", "", f"Made by {made_by}.", made_on, "", *lines]).rstrip("\n") + "\n"


def publish(text: str, out: pathlib.Path | None) -> None:
    """Prints a page, and writes it where a file is named, whose folder is made if there is none."""
    print(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
