"""Lets the API reference show names that are assigned in one line, `A, B = 1, 2`, which griffe leaves out."""

from __future__ import annotations

import ast
from typing import Any

import griffe


class TupleNames(griffe.Extension):
    """Adds each name of such a line to its module, with its own value and the string below the line."""

    def on_module_members(self, *, node: Any, mod: griffe.Module, agent: Any, **_: Any) -> None:
        """Called by griffe once the other members of a module are there."""
        del agent
        for line, below in zip(node.body, node.body[1:], strict=False):
            if not (isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Tuple)):
                continue
            text = below.value.value if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else None
            values = line.value.elts if isinstance(line.value, ast.Tuple) else [None] * len(line.targets[0].elts)
            for target, value in zip(line.targets[0].elts, values, strict=True):
                if isinstance(target, ast.Name) and text:
                    one = griffe.Attribute(target.id, value=value and ast.unparse(value), lineno=line.lineno)
                    one.docstring = griffe.Docstring(text, parent=one)
                    one.labels.add("module-attribute")
                    mod.set_member(target.id, one)
