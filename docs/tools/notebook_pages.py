"""Turns a notebook into a Markdown page: its cells and their stored outputs. Nothing is executed."""

from __future__ import annotations

import base64
from typing import Any

TESTS = {
    "01_shape_a_cable": "with a network that is not trained, one command and a coarser plant",
    "02_an_effect_of_your_own": "as it is, but with two effects to look for (`make test-full`)",
    "03_solvers": "as it is (`make test-full`)",
    "04_real_cable": "up to the diagnosis, where the recordings are present, which are not shipped (`make test-full`)",
    "05_your_own_simulator": "as it is (`make test-full`)",
    "06_record_diagnose_repeat": "as it is, but with two commands a run (`make test-full`)",
}
"""How the tests execute each notebook."""


def notebook_page(notebook: dict[str, Any], stem: str) -> tuple[str, dict[str, bytes]]:
    """The page and its images, by their names next to the page.

    Args:
        notebook: parsed `.ipynb`, format 4.
        stem: name of the notebook's file without its ending.
    """
    parts, images = [], {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        elif cell["cell_type"] == "code" and source.strip():
            parts.append(_fenced("python", source))
            for output in cell["outputs"]:
                parts.append(_output(output, stem, images))
    has_outputs = any(cell.get("outputs") for cell in notebook["cells"])
    stored = "with the outputs that are stored in it" if has_outputs else "stored without outputs"
    title, _, rest = "\n\n".join(part for part in parts if part).partition("\n")
    origin = (
        f'!!! note "This page is a notebook"\n\n    `notebooks/{stem}.ipynb`, {stored}. The tests execute it '
        f"{TESTS[stem]}; `make notebooks` executes all of them as they are.\n"
    )
    return f"{title}\n\n{origin}\n{rest}", images


def _output(output: dict[str, Any], stem: str, images: dict[str, bytes]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        name = f"{stem}_{len(images) + 1}.png"
        images[name] = base64.b64decode("".join(data["image/png"]))
        return f"![Output of the cell above]({name})"
    text = "".join(output.get("text", data.get("text/plain", "")))
    return _fenced("text", text) if text.strip() else ""


def _fenced(language: str, text: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```"
