"""Lists the public names of a package, and those without documentation, from its source alone.

A name is public if neither it nor a module on its path begins with an underscore. A module, class, function or method
is documented by its docstring. A variable of a module is documented by a string below it; a field of a class by such a
string, or by an entry under "Attributes" in the docstring of the class or of one that it inherits from.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ENTRY = re.compile(r"^\s+(\w+(?:, \w+)*)(?: \([^)]*\))?:", re.MULTILINE)
"""The start of an entry in a section of a Google docstring; names that share a line share their entry."""


class Name(NamedTuple):
    """A public name.

    Attributes:
        path: dotted, from the package on.
        kind: "module", "class", "function", "variable" or "field".
        documented: whether a reader finds out what it is.
    """

    path: str
    kind: str
    documented: bool


def public_names(package: Path) -> list[Name]:
    """Every public name of the package in a folder, in the order of its files.

    Args:
        package: folder with an `__init__.py`; its name is the package's.
    """
    trees = {module: ast.parse(path.read_text()) for module, path in _modules(package)}
    classes = {path: found for module, tree in trees.items() for path, found in _classes(module, tree)}
    found = []
    for module, tree in trees.items():
        found.append(Name(module, "module", _has_docstring(tree)))
        for owner, node, below in _members(module, tree):
            found += _names(owner, node, below, classes)
    return found


def _modules(package: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        if not any(part.startswith("_") and part != "__init__" for part in parts):
            yield ".".join(part for part in parts if part != "__init__"), path


class _Class(NamedTuple):
    """A class and the dotted paths of the names that its module knows."""

    node: ast.ClassDef
    known: dict[str, str]


def _classes(module: str, tree: ast.Module) -> Iterator[tuple[str, _Class]]:
    own = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    known = {node.name: f"{module}.{node.name}" for node in own}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            known |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in own:
        yield f"{module}.{node.name}", _Class(node, known)


def _has_docstring(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> bool:
    return bool((ast.get_docstring(node) or "").strip())


def _members(owner: str, scope: ast.Module | ast.ClassDef) -> Iterator[tuple[str, ast.stmt, ast.stmt | None]]:
    """Statements of a module and of its public classes, each with its owner and the statement below it."""
    for node, below in zip(scope.body, [*scope.body[1:], None], strict=True):
        yield owner, node, below
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from _members(f"{owner}.{node.name}", node)


def _names(owner: str, node: ast.stmt, below: ast.stmt | None, classes: dict[str, _Class]) -> list[Name]:
    """The public names that a statement defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        kind = "class" if isinstance(node, ast.ClassDef) else "function"
        return [] if node.name.startswith("_") else [Name(f"{owner}.{node.name}", kind, _has_docstring(node))]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    each = [name for target in targets for name in (target.elts if isinstance(target, ast.Tuple) else [target])]
    names = [name.id for name in each if isinstance(name, ast.Name) and not name.id.startswith("_")]
    if owner not in classes:
        return [Name(f"{owner}.{name}", "variable", _describes(below)) for name in names]
    listed = _fields(owner, classes)
    return [Name(f"{owner}.{name}", "field", _describes(below) or name in listed) for name in names]


def _describes(below: ast.stmt | None) -> bool:
    return isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)


def _fields(path: str, classes: dict[str, _Class]) -> set[str]:
    """Fields that are documented in a class or in one that it inherits from."""
    node, known = classes[path]
    section = re.search(r"^Attributes:\n((?:[ \t]+.*\n?|\n)*)", ast.get_docstring(node) or "", re.MULTILINE)
    listed = {name for entry in ENTRY.findall(section[1] if section else "") for name in entry.split(", ")}
    for statement, below in zip(node.body, node.body[1:], strict=False):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and _describes(below):
            listed.add(statement.target.id)
    for base in node.bases:
        base = base.value if isinstance(base, ast.Subscript) else base
        inherited = known.get(base.id) if isinstance(base, ast.Name) else None
        if inherited in classes:
            listed |= _fields(inherited, classes)
    return listed
