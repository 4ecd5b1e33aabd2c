"""The public names: each is the very object that its folder offers, and no folder of modules hides one."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import sarsplat

FOLDERS = {info.name for info in pkgutil.iter_modules(sarsplat.__path__)}


def test_every_public_name_is_what_its_folder_offers():
    stub = ast.parse(Path(sarsplat.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    listed = [(alias.name, node.module) for node in imports for alias in node.names]
    assert sorted(name for name, _ in listed) == sarsplat.__all__ == dir(sarsplat)
    for name, folder in listed:
        offered = importlib.import_module(f"sarsplat.{folder}")
        assert getattr(sarsplat, name) is getattr(offered, name)
        assert folder in ("errors", "scenes.simulate") or name in offered.__all__


def test_no_folder_of_modules_has_the_name_of_something_public():
    assert not FOLDERS & set(sarsplat.__all__)


def test_importing_a_folder_first_changes_no_public_name():
    code = (
        "import sys, importlib; [importlib.import_module(f'sarsplat.{name}') for name in sys.argv[1].split(',')]; "
        "import sarsplat; print(callable(sarsplat.render) and callable(sarsplat.reconstruct))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, ",".join(sorted(FOLDERS))], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "True"
