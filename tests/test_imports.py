"""Imports run one way, need no more than they say, and offer the public names."""

import ast
import importlib
import json
import pydoc
import re
import sys
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

import sarsplat
from import_graph import PACKAGE, graph, imported, modules
from programs import python
from sarsplat.extras import EXTRAS

ORDER = (
    ("geometry",),
    ("gaussians",),
    ("renderer",),
    ("scenes", "data"),
    ("tiles", "settings"),
    ("surface",),
    ("regions",),
    ("examination",),
    ("importers",),
    ("learning", "executors"),
    ("runs",),
    ("radar", "baselines"),
    ("evaluation",),
    ("samples", "exports"),
    ("report",),
    ("viewer", "sweeps", "recognition"),
    ("cli",),
)
RANK = {folder: rank for rank, folders in enumerate(ORDER) for folder in folders}


def rooms(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "sarsplat" and len(parts) > 1 else None


def third_party(path: Path) -> set[str]:
    return {module.split(".")[0] for module in imported(path)} - set(sys.stdlib_module_names) - {"sarsplat"}


def test_every_folder_has_a_place_in_the_order():
    assert {p.parent.name for p in PACKAGE.glob("*/__init__.py")} == set(RANK)


def test_contributing_has_a_map_of_the_rooms_in_this_order():
    page = (PACKAGE.parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| .+ \|$", page, re.MULTILINE)
    assert rows == [folder for folders in ORDER for folder in folders]


@pytest.mark.parametrize("folder", RANK)
def test_imports_run_one_way(folder):
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for path in sorted((PACKAGE / folder).rglob("*.py"))
        for module in sorted(imported(path))
        if (room := rooms(module)) in RANK and room != folder and RANK[room] >= RANK[folder]
    ]
    assert not wrong


@pytest.mark.parametrize("name", ["errors", "arguments", "names", "radiometry", "colours"])
def test_the_bottom_imports_no_room(name):
    """What every room may use."""
    path = PACKAGE / f"{name}.py"
    assert not {rooms(module) for module in imported(path)} & set(RANK)
    assert third_party(path) <= {"numpy", "jaxtyping"} | ({"matplotlib"} if name == "colours" else set())


def test_no_files_import_each_other_in_a_circle():
    """Neither at the top, nor inside functions, nor for the sake of types."""
    TopologicalSorter(graph()).prepare()  # which names those that do
    assert "errors" in graph()["data.files"]
    assert "data" not in graph()["data.dataset"]


def test_nothing_imports_the_package_itself():
    """`sarsplat/__init__.py` gathers the public names; going through it would hide a cycle."""
    for path in PACKAGE.rglob("*.py"):
        if path.parent != PACKAGE and path.parent.name != "cli":
            assert "sarsplat" not in imported(path), path


def test_the_renderer_imports_torch_and_numpy_only():
    for folder in ("geometry", "gaussians", "renderer"):
        for path in (PACKAGE / folder).rglob("*.py"):
            more = {"scipy"} if path.name == "initialise.py" else set()
            assert third_party(path) <= {"torch", "numpy", "jaxtyping"} | more, path


def test_the_engines_alone_know_ctypes():
    """Beside them, what Python has no function for: giving memory back, dying together."""
    others = {"runs.tiled_training", "samples.write"}
    known = {name for name, path in modules().items() if "ctypes" in imported(path)}
    assert {name for name in known if not name.startswith("renderer.engines.")} == others


def test_the_engines_need_little_of_the_renderer():
    own = {"renderer.checks", "renderer.constants", "renderer.rendering"}
    for name, needed in graph().items():
        if name.startswith("renderer.engines."):
            outside = {one for one in needed if one.startswith("renderer.") and not one.startswith("renderer.engines")}
            assert outside <= own, name


FRESH = """
import importlib, json, os, pkgutil, signal, sys

def answer(question, found):
    print(json.dumps([question, found]), flush=True)

def forget():
    for name in [name for name in sys.modules if name.partition(".")[0] == "sarsplat"]:
        del sys.modules[name]

def import_all():
    for info in pkgutil.walk_packages(importlib.import_module("sarsplat").__path__, "sarsplat."):
        if not info.name.endswith("._engine"):
            importlib.import_module(info.name)

out, *lists = sys.argv[1:]
rooms, extras, names = (words.split(",") for words in lists)

for folder in ("renderer", "scenes"):
    forget()
    exec(f"from sarsplat.{folder} import *", {})
    answer(folder, sorted(sys.modules))

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in extras:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
for name in [name for name in sys.modules if name.partition(".")[0] in extras]:
    del sys.modules[name]
forget()
for folder in rooms:
    importlib.import_module(f"sarsplat.{folder}")
import sarsplat
answer("folders first", callable(sarsplat.render) and callable(sarsplat.reconstruct))
import_all()
for name in sarsplat.__all__:
    getattr(sarsplat, name)
answer("extras", sorted({*extras} & {name.partition(".")[0] for name in sys.modules}))
import torch
from sarsplat import Gaussians, Harmonics, ImageGrid, View, render
one = Gaussians(*(torch.ones(1, k) for k in (3, 4, 3)), torch.ones(1), Harmonics(torch.ones(1, 1)))
answer("sum", float(render(one, [View(30.0, 40.0)], ImageGrid(32, 32, (0.3, 0.3), (0.3, 0.3))).images.sum()))
from sarsplat.cli import main
answer("simulate", main(["simulate", "--target", "t72", "--out", out]))

forget()  # other packages know their platform and are in memory from here on
for name in ("fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty"):
    sys.modules[name] = None
for name in names if sys.platform == "linux" else []:
    delattr(signal if name.startswith("SIG") else os, name)
import_all()
answer("as on Windows", sorted({name for name in sys.modules if name.startswith("sarsplat.")}))
"""
UNIX_NAMES = (
    *("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "O_SYNC", "chown", "fdatasync", "fork", "getloadavg"),
    *("geteuid", "getpgid", "getuid", "killpg", "mkfifo", "nice", "sched_getaffinity", "setsid", "statvfs", "sysconf"),
    *("uname", "SIGALRM", "SIGHUP", "SIGKILL", "SIGTSTP", "SIGUSR1", "SIGWINCH"),
)
"""Of `os` and `signal`: what Windows lacks."""


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a fresh interpreter finds out, by question; one is asked everything, for each takes seconds to begin."""
    out = tmp_path_factory.mktemp("fresh") / "out"
    extras = {module for modules in EXTRAS.values() for module in modules}
    lists = (",".join(words) for words in (RANK, sorted(extras), UNIX_NAMES))
    done = python("-W", "error", "-c", FRESH, out, *lists)
    assert done.returncode == 0, done.stderr
    return {**dict(map(json.loads, done.stdout.splitlines())), "stderr": done.stderr, "written": out.exists()}


@pytest.mark.parametrize(("folder", "more"), [("renderer", set()), ("scenes", {"scipy"})])
def test_importing_the_renderer_or_scenes_loads_little_more(folder, more, fresh):
    """And scenes, which are truth, never the renderer."""
    loaded = fresh[folder]
    heavy = {"scipy", "safetensors", "tifffile", "rich", "tyro", "trimesh", "embreex", "matplotlib", "PIL", "sklearn"}
    assert not {module.split(".")[0] for module in loaded} & heavy - more
    assert {rooms(module) for module in loaded} & set(RANK) == {"geometry", "gaussians", folder}


def test_everything_imports_and_renders_with_the_core_dependencies_alone(fresh):
    assert fresh["extras"] == []
    assert fresh["sum"] > 0
    assert fresh["simulate"] == 2
    assert "which is not installed; install it with: pip install 'sarsplat[simulate]'" in " ".join(
        fresh["stderr"].split()
    )
    assert not fresh["written"]


@pytest.mark.skipif(sys.platform != "linux", reason="takes from Linux what Windows lacks")
def test_everything_imports_without_what_windows_lacks(fresh):
    assert {f"sarsplat.{name}" for name in modules()} - {"sarsplat."} <= {*fresh["as on Windows"]}


# ---- the geometry of views ------------------------------------------------------------------------------------------
ANGLES = {"azimuth_deg", "grazing_deg", "incidence_deg"}
TRIGONOMETRY = {"sin", "cos", "tan", "radians", "deg2rad"}
WITHOUT_A_LOOK = {
    *("radiometry.py", "cli/info_dataset.py", "report/sheet.py"),
    *("examination/neighbouring_views.py", "importers/listed_images.py"),
}
"""Converts for an angle that users give; draw angles on a round map; asks in which sense azimuths run; by how much a
stated tilt turns a heading."""


def computed_with(text: str) -> list[int]:
    """Lines that compute with an angle of a view."""
    if not any(angle in text for angle in ANGLES):
        return []
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return [
        call.lineno
        for call in calls
        if getattr(call.func, "attr", getattr(call.func, "id", None)) in TRIGONOMETRY
        and ANGLES & {getattr(node, "attr", getattr(node, "id", None)) for node in ast.walk(call)}
    ]


def test_only_the_look_computes_with_angles_of_views():
    """Another kind of look is then one file: all others ask `View.look`."""
    assert computed_with("a = 1\nnp.tan(np.radians([view.grazing_deg for view in views]))") == [2, 2]
    found = {
        path.relative_to(PACKAGE).as_posix(): lines
        for path in PACKAGE.rglob("*.py")
        if (lines := computed_with(text := path.read_text(encoding="utf-8")))
        or ("radar_frame" in text and path.parent.name != "geometry")
    }
    assert found.keys() == {"geometry/look.py"} | WITHOUT_A_LOOK, found


# ---- public names ----------------------------------------------------------------------------------------------------
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
    assert not RANK.keys() & set(sarsplat.__all__)


def test_importing_a_folder_first_changes_no_public_name(fresh):
    assert fresh["folders first"] is True


@pytest.mark.parametrize("package", ["sarsplat.gaussians", "sarsplat.renderer", "sarsplat.geometry", "sarsplat.radar"])
def test_help_names_nothing_private(package: str) -> None:
    module = importlib.import_module(package)
    for name in module.__all__:
        text = pydoc.plain(pydoc.render_doc(getattr(module, name)))
        assert re.findall(r"(?<![\w.])_[a-z]\w*", text) == [], name  # numpy._core is not ours
