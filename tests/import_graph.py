"""Which module of the package imports which: read from the source, nothing is executed."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import sarsplat

PACKAGE = Path(sarsplat.__file__).parent


def modules() -> dict[str, Path]:
    """The file of every module by its dotted name below the package; a folder's `__init__` has that of the folder."""
    relative = {path: path.relative_to(PACKAGE).with_suffix("").parts for path in sorted(PACKAGE.rglob("*.py"))}
    return {".".join(part for part in parts if part != "__init__"): path for path, parts in relative.items()}


def imported(path: Path) -> set[str]:
    """Every module a file imports, at the top or inside a function, as absolute dotted names."""
    return {name for pair in _imports(path) for name in pair}


def graph(*, for_types: bool = True) -> dict[str, set[str]]:
    """The modules of the package that each imports; a name that is a module stands for that, not for its folder.

    What stands under `if TYPE_CHECKING` is not executed; it counts unless `for_types` is false.
    """
    files = modules()
    edges = {}
    for name, path in files.items():
        pairs = [[part.removeprefix("sarsplat.") for part in pair] for pair in _imports(path, for_types)]
        edges[name] = {inner if inner in files else outer for outer, inner in pairs} & files.keys() - {name}
    return edges


@cache
def _imports(path: Path, for_types: bool = True) -> tuple[tuple[str, str], ...]:
    """Of each name that is imported, the module and what would be its name if it were a module, too."""
    found: list[tuple[str, str]] = []
    for node in _statements(ast.parse(path.read_text(encoding="utf-8")), for_types):
        if isinstance(node, ast.Import):
            found += ((alias.name, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module and node.level == 0, f"{path}: relative import"
            found += ((node.module, f"{node.module}.{alias.name}") for alias in node.names)
    return tuple(found)


def _statements(node: ast.AST, for_types: bool) -> Iterator[ast.AST]:
    """Every statement in it; there are none inside expressions, which are most of the nodes."""
    for field in ("body", "orelse", "handlers", "finalbody", "cases"):
        for child in getattr(node, field, ()):
            if for_types or not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)):
                yield child
                yield from _statements(child, for_types)
