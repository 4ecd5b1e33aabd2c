"""Which code made a result: a digest of everything that a score depends on."""

from __future__ import annotations

import ast
import hashlib
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "src" / "sarsplat"

_LEFT_OUT = ("cli", "report")
"""Folders that decide no score, apart from what makes a dataset of the options of `simulate`."""


def code_version(package: Path = PACKAGE) -> str:
    """Digest of the package's sources, ten hexadecimal digits; comments and docstrings do not count.

    Parameters
    ----------
    package : pathlib.Path
        Folder of the sources.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        inside = path.relative_to(package)
        if inside.parts[0] in _LEFT_OUT and not inside.name.startswith("simulat"):
            continue
        if path.suffix == ".py":
            content = _without_words(path.read_text(encoding="utf-8")).encode()
        elif "csrc" in inside.parts and path.is_file():
            content = path.read_bytes()
        else:
            continue
        digest.update(f"{inside.as_posix()}\n".encode())
        digest.update(content)
    return digest.hexdigest()[:10]


def _without_words(source: str) -> str:
    """What a Python source does."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(statements := getattr(node, "body", None), list):
            node.body = [statement for statement in statements if not _is_text(statement)]
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
