"""Writes the pages of the API reference, one for each room of the package, from the source alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import griffe

EXPLAINED = {
    "adaptation": "[Correct](../concepts/correct.md)",
    "bounded": "[Solvers](../concepts/solvers.md), [a solver of your own](../how_to/own_solver.md)",
    "cablejax": "[The pipeline](../concepts/index.md), [a cable of your own](../how_to/own_cable.md)",
    "commands": "[The command line](../command_line.md)",
    "control": "[Control](../concepts/control.md), [shape a cable](../notebooks/01_shape_a_cable.md)",
    "dataset": "[Learn](../concepts/learn.md)",
    "diagnose": "[Diagnose](../concepts/diagnose.md), [a simulator of your own](../how_to/own_simulator.md)",
    "dynamics": "[Learn](../concepts/learn.md), [a dynamics model of your own](../how_to/own_dynamics_model.md)",
    "effects": "[Diagnose](../concepts/diagnose.md), [an effect of your own](../how_to/own_effect.md)",
    "environment": "[Train a policy](../how_to/environment.md)",
    "mpc": "[Control](../concepts/control.md), [Solvers](../concepts/solvers.md)",
    "perceive": "[Perceive](../concepts/perceive.md)",
    "recordings": "[A recording of your own](../how_to/own_recording.md), [exported logs](../how_to/look.md)",
    "report": "[Read a verdict](../how_to/read_a_verdict.md), [look at it](../how_to/look.md)",
    "residual": "[Correct](../concepts/correct.md)",
    "robot": "[Use a robot](../how_to/robot.md)",
    "simulate": "[Simulate](../concepts/simulate.md), [Plants](../concepts/plants.md)",
    "spatial": "[Cables in space](../concepts/space.md)",
}
"""Where each room is explained, with examples; a room without an entry fails the build."""


def api_pages(package: Path) -> dict[str, str]:
    """Markdown by the path of its page: `api/index.md`, and `api/ROOM.md` for each folder of the package.

    The modules in the package's own folder share the page of the package.

    Args:
        package: the package's folder.

    Raises:
        KeyError: if `EXPLAINED` has no entry for a folder.
    """
    whole = griffe.load(package.name, search_paths=[package.parent])
    inner = {room.name: room for room in _inside(whole) if room.is_subpackage}
    pages = {f"api/{name}.md": _room_page(room, list(_modules(room))) for name, room in inner.items()}
    files = [module for module in _inside(whole) if module.name not in inner]
    pages[f"api/{package.name}.md"] = _room_page(whole, files)
    own = f"| [`{package.name}`]({package.name}.md) | The cable, the types, the files and the command line. |"
    rows = [f"| [`{room.path}`]({name}.md) | {_summary(room)} |" for name, room in inner.items()]
    return pages | {"api/index.md": "\n".join([_INDEX, own, *rows, ""])}


_INDEX = """# API reference

Every public name of the package, from its docstring. Each subpackage has a page; at the top of a page are the names
that it exports. Shapes are written as `[E, T, N, D]`:

| letter | size | letter | size |
| --- | --- | --- | --- |
| B | batch | N | keypoints |
| E | episodes | Q | grippers |
| T | time samples | J | bending joints |
| H | history | D | 2 or 3 coordinates |

SI units and radians everywhere. A field of a class is described in the class's list of attributes.

| subpackage | what it does |
| --- | --- |"""


def _room_page(room: griffe.Module, modules: list[griffe.Module]) -> str:
    parts = [f"# {room.path}", "", f"Explained, with examples: {EXPLAINED[room.name]}.", ""]
    exported = [room[name].final_target if room[name].is_alias else room[name] for name in room.exports or ()]
    if exported:
        parts += ["| name | what it is |", "| --- | --- |"]
        parts += [f"| [`{one.name}`][{one.path}] | {_summary(one)} |" for one in exported]
    return "\n".join([*parts, *(_directive(module) for module in [room, *modules])])


def _directive(module: griffe.Module) -> str:
    """What mkdocstrings replaces by the module's documentation; of a folder's, without the names that it gathers."""
    if not module.is_init_module:
        return f"\n::: {module.path}\n"
    own = [name for name, one in module.members.items() if not one.is_alias and not one.is_module and name[0] != "_"]
    return f"\n::: {module.path}\n    options:\n      members: {own or 'false'}\n"


def _inside(room: griffe.Module) -> list[griffe.Module]:
    """The public modules of a folder; a module that is imported from elsewhere is none of them."""
    modules = [module for _, module in sorted(room.modules.items()) if not module.is_alias]
    return [module for module in modules if not module.name.startswith("_")]


def _modules(room: griffe.Module) -> Iterator[griffe.Module]:
    """The public modules below a room, in the order of their names."""
    for module in _inside(room):
        yield module
        yield from _modules(module)


def _summary(one: griffe.Object) -> str:
    """The first paragraph of a docstring, for a cell of a table."""
    paragraph = one.docstring.value.split("\n\n")[0] if one.docstring else ""
    # Markdown's tables know code by themselves
    text = " ".join(paragraph.split()).split("`")
    return "`".join(part if inside % 2 else part.replace("|", "\\|") for inside, part in enumerate(text))
