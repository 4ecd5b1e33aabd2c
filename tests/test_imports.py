"""Imports run one way, and the renderer needs torch and numpy only."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sarsplat

PACKAGE = Path(sarsplat.__file__).parent
ORDER = (
    ("geometry",),
    ("gaussians",),
    ("render",),
    ("scenes", "data"),
    ("reconstruct",),
    ("evaluate",),
    ("report",),
    ("cli",),
)
RANK = {folder: rank for rank, folders in enumerate(ORDER) for folder in folders}


def imported(path: Path) -> set[str]:
    """Every module a file imports, at the top or inside a function, as absolute dotted names."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def rooms(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "sarsplat" and len(parts) > 1 else None


def test_every_folder_has_a_place_in_the_order():
    assert {p.parent.name for p in PACKAGE.glob("*/__init__.py")} == set(RANK)


@pytest.mark.parametrize("folder", RANK)
def test_imports_run_one_way(folder):
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for path in sorted((PACKAGE / folder).rglob("*.py"))
        for module in sorted(imported(path))
        if (room := rooms(module)) in RANK and room != folder and RANK[room] >= RANK[folder]
    ]
    assert not wrong


def test_nothing_imports_the_package_itself():
    """`sarsplat/__init__.py` gathers the public names; going through it would hide a cycle."""
    for path in PACKAGE.rglob("*.py"):
        names = {
            n.module for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.ImportFrom)
        }
        if path.parent != PACKAGE and path.parent.name != "cli":
            assert "sarsplat" not in names, path


def test_the_renderer_imports_torch_and_numpy_only():
    allowed = {"torch", "numpy", "sarsplat"} | set(sys.stdlib_module_names)
    for folder in ("geometry", "gaussians", "render"):
        for path in (PACKAGE / folder).glob("*.py"):
            third_party = {module.split(".")[0] for module in imported(path)} - allowed
            assert third_party <= ({"scipy"} if path.name == "initialise.py" else set()), path


def test_importing_the_renderer_loads_nothing_more():
    loaded = subprocess.run(
        [sys.executable, "-c", "import sys, sarsplat.render; print(*sorted(sys.modules))"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    heavy = {"scipy", "safetensors", "plyfile", "tifffile", "rich", "tyro", "trimesh", "matplotlib", "PIL", "sklearn"}
    assert not {module.split(".")[0] for module in loaded} & heavy
    assert not [
        m
        for m in loaded
        if m.startswith("sarsplat.") and m.split(".")[1] not in ("errors", "geometry", "gaussians", "render")
    ]
