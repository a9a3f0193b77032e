"""`cablejax view`: writes the page of a file or folder of this package."""

from __future__ import annotations

import dataclasses
import pathlib
import shutil
from typing import TYPE_CHECKING, Annotated

import tyro

from cablejax.commands.artefacts import PAGE, Kind, kind_of
from cablejax.commands.export import read_log
from cablejax.commands.options import Command, UsageError, output_file

if TYPE_CHECKING:
    from cablejax.report.sheet import Sheet


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Command):
    """Write an HTML page of anything that cablejax has written, and print the page's path.

    Takes a gap log, a data set, weights, a verdict, the folder of a run, or a cable file, and recognises it by its
    content. Runs and diagnoses already have a page; the others get one.

    Attributes:
        artefact: The file or folder, a place in object storage (s3://BUCKET/PREFIX), or a released model by name.
        out: The page to write, an .html file. By default next to the file, with its name, or here where that is in
            object storage; a run's page stays where it is.
        overwrite: Replace a page that is there.
        browser: Also open the page in this machine's web browser.
    """

    artefact: Annotated[pathlib.Path, tyro.conf.Positional]
    out: pathlib.Path | None = None
    overwrite: bool = False
    browser: bool = False

    def execute(self):
        """Recognises the file or folder, writes its page and prints the path."""
        kind, path = kind_of(self.artefact)
        page, title = self._page(kind, path), "The page of a run."
        if kind != "run" or self.out is not None:
            if page.suffix.lower() not in (".html", ".htm"):
                raise UsageError(f"--out is {page}, expected a file name that ends in .html.")
            output_file(page, overwrite=self.overwrite)
            if kind == "run":
                page.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path / PAGE, page)
            else:
                from cablejax.report.sheet import write_sheet

                sheet = sheet_of(kind, path)
                write_sheet(page, sheet)
                title = f"{sheet.kind.capitalize()}: {sheet.title}"
        if self.browser:
            import webbrowser

            if not webbrowser.open(page.resolve().as_uri()):
                title = f"{title} No web browser was found here: copy the page to a machine that has one."
        return {"kind": kind, "title": title, "page": str(page)}, f"{title}\n{page}"

    def _page(self, kind: Kind, path: pathlib.Path) -> pathlib.Path:
        if self.out is not None:
            return self.out
        if kind == "run":
            return path / PAGE
        named = path.resolve() if path.name in ("", "..") else path
        page = named.with_name(f"{named.stem}.html")
        return page if path.exists() else pathlib.Path(page.name)


def sheet_of(kind: Kind, path: pathlib.Path) -> Sheet:
    """The sheet of a file or folder of one kind.

    Raises:
        ValueError: it cannot be read.
    """
    from cablejax.report import log_sheet, made_sheets, sheet

    if kind == "cable":
        from cablejax.cable_file import read_cable

        return sheet.cable_sheet(read_cable(path), str(path))
    if kind == "store":
        from cablejax.dataset.opening import open_store

        return made_sheets.store_sheet(open_store(path), str(path))
    if kind == "weights":
        return made_sheets.weights_sheet(path, str(path))
    if kind == "verdict":
        from cablejax.diagnose.verdict_json import read_verdict
        from cablejax.effects.verdicts import effects_of_verdict

        found, addable = read_verdict(path), True
        try:
            effects_of_verdict(path)
        except ValueError:  # none is named, or of a cable in space or another simulator
            addable = False
        return made_sheets.verdict_sheet(found, str(path), addable=addable)
    return log_sheet.log_sheet(read_log(kind, path), str(path), "" if kind == "log" else kind)
