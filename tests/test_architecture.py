"""The package keeps to its map: rooms import downwards, modules in no circle, and nothing grows too long to be read."""

from __future__ import annotations

import ast
import functools
import graphlib
import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).parents[1]
SOURCE = ROOT / "src"
FILE_LINES, FUNCTION_LINES = 300, 80
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((SOURCE / "cablejax").rglob("*.py"))
}


@functools.cache
def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text())


def imports(module: str) -> set[str]:
    """The package's modules that a module imports, inside functions too, but not those for type checking alone."""
    found = set()
    for node in ast.walk(_without_type_checking(tree(module))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {name if name in MODULES else node.module for name in names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & set(MODULES)


def _without_type_checking(module: ast.Module) -> ast.Module:
    body = [n for n in module.body if not (isinstance(n, ast.If) and getattr(n.test, "id", "") == "TYPE_CHECKING")]
    return ast.Module(body, [])


def room(module: str) -> str:
    """The folder that a module lives in; a module of the package's own folder is a room by itself."""
    return [*module.split("."), ""][1]


def arrows() -> dict[str, set[str]]:
    """The map of `CONTRIBUTING.md`: of each room, those that it may import, directly or through others."""
    direct: dict[str, set[str]] = {}
    for above, below in re.findall(r"^ +(\w+) --> (\w+)$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE):
        direct.setdefault(above, set()).add(below)
        direct.setdefault(below, set())
    below: dict[str, set[str]] = {}
    for name in graphlib.TopologicalSorter(direct).static_order():  # raises on a circle
        below[name] = direct[name].union(*(below[other] for other in direct[name]))
    return below


def test_every_room_is_on_the_map():
    rooms = {path.name for path in (SOURCE / "cablejax").iterdir() if (path / "__init__.py").exists()}
    assert rooms == set(arrows()) - {"cable"}


def test_rooms_import_downwards():
    below = arrows()
    upwards = [
        f"{module} imports {other}"
        for module in MODULES
        for other in sorted(imports(module))
        if room(module) in below
        and (room(other) in below or room(other) in ("cli", "__main__"))
        and room(other) not in below[room(module)] | {room(module)}
    ]
    assert not upwards, "\n".join(upwards)


def test_no_modules_import_in_a_circle():
    # A package's `__init__` gathers its own modules, which may import each other through their own names only.
    graph = {module: imports(module) - {module} for module in MODULES}
    try:
        list(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_no_file_is_too_long():
    lengths = {module: len(path.read_text().splitlines()) for module, path in MODULES.items()}
    assert not {module: length for module, length in lengths.items() if length > FILE_LINES}


def test_no_function_is_too_long():
    functions = [
        (module, node)
        for module in MODULES
        for node in ast.walk(tree(module))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    ]
    lengths = {f"{module}.{node.name}": (node.end_lineno or 0) - node.lineno + 1 for module, node in functions}
    assert not {name: length for name, length in lengths.items() if length > FUNCTION_LINES}
