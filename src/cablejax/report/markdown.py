"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; the first row is its title."""
    title, *rest = ["| " + " | ".join(row) + " |" for row in rows]
    return [title, "|" + " --- |" * len(rows[0]), *rest]
