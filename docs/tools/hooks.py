"""What the documentation site adds to MkDocs: generated pages, links that work on GitHub too, formulas, and a check.

README, CONTRIBUTING, CHANGELOG and the notebooks become pages, so that nothing is written twice. Links are written as
GitHub follows them, relative to the file; here they are turned into links between pages. Formulas become MathML, which
browsers draw without a script. The build fails if a public name has no documentation or is on no page.
"""

from __future__ import annotations

import html
import json
import posixpath
import re
from pathlib import Path
from typing import Any

import latex2mathml.converter
from api_pages import api_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from notebook_pages import notebook_page
from public_names import public_names

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "cablejax"
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Files outside `docs` that are pages, by their path in the repository."""
NOTEBOOKS = {f"notebooks/{path.name}": f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
SHIM = "assets/iframe-worker.js"
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\])\(([^()#\s:]+)(#[^()\s]*)?\)")
MERMAID = re.compile(r"```mermaid\n(.*?)```", re.DOTALL)
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are not files of `docs`."""
    generated: dict[str, str | bytes] = {page: (ROOT / path).read_text() for path, page in PAGES.items()}
    for path, page in NOTEBOOKS.items():
        generated[page], images = notebook_page(json.loads((ROOT / path).read_text()), Path(path).stem)
        generated |= {posixpath.join(posixpath.dirname(page), name): image for name, image in images.items()}
    generated |= api_pages(PACKAGE)
    for path, content in generated.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turns links between files of the repository into links between pages, and the map of the code into a table."""
    source = {site: path for path, site in {**PAGES, **NOTEBOOKS}.items()}.get(page.file.src_uri)
    source = source or f"docs/{page.file.src_uri}"

    def link(found: re.Match[str]) -> str:
        text, target, anchor = found[1], found[2], found[3] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        site = {**PAGES, **NOTEBOOKS}.get(path) or path.removeprefix("docs/")
        if files.get_file_from_path(site):
            return f"{text}({posixpath.relpath(site, posixpath.dirname(page.file.src_uri) or '.')}{anchor})"
        return text[1:-1] if (ROOT / path).exists() and not path.startswith("docs/") else found[0]

    return LINK.sub(link, MERMAID.sub(lambda found: _arrows(found[1]), markdown))


def _arrows(mermaid: str) -> str:
    """The arrows of the map of the code as a table."""
    above: dict[str, list[str]] = {}
    for left, right in re.findall(r"^\s*(\w+)\s*-->\s*(\w+)$", mermaid, re.MULTILINE):
        above.setdefault(left, []).append(right)
    rows = [f"| `{left}` | {', '.join(f'`{name}`' for name in right)} |" for left, right in above.items()]
    return "\n".join(["| subpackage | may import |", "| --- | --- |", *rows, ""])


def on_page_content(content: str, **_: Any) -> str:
    """Draws formulas as MathML."""

    def formula(found: re.Match[str]) -> str:
        display = "block" if found[2] == "[" else "inline"
        return latex2mathml.converter.convert(html.unescape(found[3]), display=display)

    return FORMULA.sub(formula, content)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Takes the one script that the theme would fetch, for the search on pages in a folder, from the site itself."""
    here = posixpath.relpath(SHIM, posixpath.dirname(page.url) or ".")
    return output.replace("https://unpkg.com/iframe-worker/shim", here)


def on_post_build(config: MkDocsConfig) -> None:
    """Fails if a public name is undocumented or has no place on an API page.

    Raises:
        PluginError: with the names.
    """
    pages = "".join(path.read_text() for path in (Path(config.site_dir) / "api").glob("*.html"))
    places = set(re.findall(r'\bid="(cablejax[\w.]*)"', pages))
    names = public_names(PACKAGE)
    undocumented = [name.path for name in names if not name.documented]
    # fields are in the list of their class, which has the place
    missing = [name.path for name in names if name.kind != "field" and name.path not in places]
    if undocumented or missing:
        raise PluginError(f"Public names without documentation: {undocumented}; on no API page: {missing}.")
