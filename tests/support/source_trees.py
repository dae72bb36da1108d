"""The syntax trees of the project's modules, parsed once for all tests of a process."""

from __future__ import annotations

import ast
import gc
from functools import cache
from pathlib import Path


@cache
def nodes_of(file: Path) -> tuple[ast.AST, ...]:
    """Returns every node of a module, in the order of `ast.walk`: the module itself first. Do not change them."""
    gc.disable()  # a million objects that all stay
    nodes = tuple(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    gc.freeze()
    gc.enable()
    return nodes
