"""What all tests share."""

import gc
import importlib
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

# before torch is loaded: threads that spin while they wait stall everyone on a shared machine
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest

import shapes
from programs import ROOT


def pytest_collection() -> None:
    """Before any test is imported; not in a process that only hands them out to others."""
    from sarsplat.renderer.engines import cpu

    shapes.watch()
    # `make sanitize` runs the renderer's tests on an engine of its own making
    if (engine := os.environ.get("SARSPLAT_TEST_ENGINE")) is not None:
        cpu.LIBRARY = Path(engine)


def pytest_collection_finish() -> None:
    """What was imported stays; the garbage collector need not look through it again and again."""
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def few_samples() -> Iterator[None]:
    """Runs are scored with 5000 samples of each surface, not a million; pictures are small, previews have one image."""
    from sarsplat.evaluation.surface import visible_surface
    from sarsplat.report.sheet import check_sheet

    def coarse(mesh: Any, views: Any, ray_spacing: float, advanced: Any) -> Any:
        return visible_surface(mesh, views, ray_spacing=5 * ray_spacing, samples=5000, advanced=advanced)

    def of_one(dataset: Any, most: int = 1, orientations: Any = ()) -> bytes:
        return check_sheet(dataset, most, orientations)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sarsplat.evaluation.evaluate.visible_surface", coarse)
        patch.setattr("sarsplat.evaluation.evaluate._MESH_SAMPLES", 5000)
        patch.setattr("sarsplat.report.sheet.check_sheet", of_one)
        patch.setattr("sarsplat.report.write._SURFACE_SAMPLES", 500)
        patch.setattr("sarsplat.report.boards._PIXELS", 40)
        patch.setattr("sarsplat.report.widget._MOST_RENDERED", 3000)
        yield


@pytest.fixture(scope="module", autouse=True)
def nothing_is_synced() -> Iterator[None]:
    """No test pulls the plug, and a shared disk takes tens of milliseconds to sync a file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session")
def small_box(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A dataset that nobody may change: a box on the ground in 28 × 24 pixels from twelve sides, with masks."""
    from made import box_dataset
    from sarsplat.geometry import ImageGrid

    grid = ImageGrid(28, 24, (0.3, 0.35), (0.3, 0.35))
    return box_dataset(tmp_path_factory.mktemp("small-box"), grid, masks=True)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A dataset that nobody may change: a box in 32 × 32 pixels from twelve sides, to learn from."""
    from made import box_dataset
    from sarsplat.geometry import ImageGrid

    return box_dataset(tmp_path_factory.mktemp("box"), ImageGrid(32, 32, (0.3, 0.3), (0.45, 0.45)))


@pytest.fixture(scope="session")
def config() -> Any:
    """Settings of a short training on it."""
    from made import FEW_POINTS
    from sarsplat import preset

    short = {"iterations": 60, "gaussians": 600, "harmonics_every": 20, "checkpoint_every": 20}
    return replace(preset("default"), **short, points=FEW_POINTS)


@pytest.fixture(scope="session")
def finished(dataset: Any, config: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The run of that training, which nobody may change."""
    from sarsplat import reconstruct

    return reconstruct(dataset, config, tmp_path_factory.mktemp("run") / "run")


@pytest.fixture(scope="session")
def library(request: pytest.FixtureRequest) -> Path:
    """The emulated CUDA engine, compiled once."""
    pytest.importorskip("ziglang", reason="the emulator is compiled with ziglang")
    from emulated_cuda import compile_emulator

    return compile_emulator(Path(request.config.cache.mkdir("cuda-emulator")))


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Sets torch's thread count; the old one comes back."""
    import torch

    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], ModuleType]]:
    """Imports a program by its path, such as experiments/tables; gone again afterwards, with all beside it."""
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")  # and unset afterwards
    before = set(sys.modules)

    def load(path: str) -> ModuleType:
        folder, _, name = path.partition("/")
        monkeypatch.syspath_prepend(str(ROOT / folder))
        return importlib.import_module(name)

    yield load
    for name in set(sys.modules) - before:
        if Path(getattr(sys.modules[name], "__file__", None) or "/").parent.parent == ROOT:
            del sys.modules[name]


@pytest.fixture
def beside(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., list[tuple[int, str, str]]]]:
    """Runs commands beside a folder of packages as if those were installed: exit codes, and what is said of what."""
    from sarsplat import cli
    from sarsplat.cli.importers import IMPORTERS
    from sarsplat.exports import FORMATS
    from sarsplat.names import SCATTERINGS

    before = set(sys.modules)

    def done(site: Path, *commands: str) -> list[tuple[int, str, str]]:
        monkeypatch.chdir(site.parent)
        monkeypatch.syspath_prepend(site)
        for plugins in (FORMATS, IMPORTERS, SCATTERINGS):
            monkeypatch.setattr(plugins, "_entries", plugins._search())
            monkeypatch.setattr(plugins, "_loaded", {})
        # its options name the laws that there were when it was imported
        monkeypatch.setattr(cli, "reconstruct", importlib.import_module("sarsplat.cli.reconstruct"))
        monkeypatch.delitem(sys.modules, "sarsplat.cli.reconstruct")
        return [(cli.main(shlex.split(words)), *capsys.readouterr()) for words in commands]

    yield done
    for name in set(sys.modules) - before:
        if Path(getattr(sys.modules[name], "__file__", None) or "/").parent.name == "site":
            del sys.modules[name]
