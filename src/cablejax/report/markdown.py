"""Pages in Markdown, and their tables."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence


def markdown_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; the first row is its title."""
    title, *rest = ["| " + " | ".join(row) + " |" for row in rows]
    return [title, "|" + " --- |" * len(rows[0]), *rest]


def publish(text: str, out: pathlib.Path | None) -> None:
    """Prints a page, and writes it where a file is named, whose folder is made if there is none."""
    print(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
