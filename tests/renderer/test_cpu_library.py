"""Loading the CPU engine: without torch's threads it works on one; without the library the reference still renders."""

from __future__ import annotations

import pytest
import torch

from sarsplat.cli import main
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, View
from sarsplat.renderer import cpu, render

GAUSSIANS = Gaussians(
    *(torch.ones(1, k) for k in (3, 4, 3)), optical_depth=torch.ones(1), scattering=Harmonics(torch.ones(1, 1))
)
VIEWS = [View(azimuth, 40.0) for azimuth in range(0, 360, 15)]
GRID = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))


@pytest.fixture
def reload(monkeypatch: pytest.MonkeyPatch):
    """Loads the engine anew, in the test and after it."""
    cpu.library.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    cpu.library.cache_clear()
    cpu.library()


def test_without_the_threads_of_torch_the_engine_runs_on_one_and_doctor_says_so(reload, capsys):
    expected = render(GAUSSIANS, VIEWS, GRID, engine="cpu").images
    assert main(["doctor"]) == 0
    assert "on the threads of PyTorch" in " ".join(capsys.readouterr().out.split())
    for library in ("libnothing.so", "libc10.so"):  # no such library; a library without the function
        reload.setattr(cpu, "_TORCH", library)
        cpu.library.cache_clear()
        with pytest.warns(SarsplatWarning, match=r"runs on one thread, because PyTorch .* has no torch_parallel_for"):
            assert torch.equal(render(GAUSSIANS, VIEWS, GRID, engine="cpu").images, expected)
        assert torch.equal(render(GAUSSIANS, VIEWS, GRID, engine="cpu").images, expected)  # which is said once
        assert main(["doctor"]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert f"on one thread, because PyTorch {torch.__version__} has no torch_parallel_for" in said


def test_without_the_library_the_reference_still_renders(reload, tmp_path, capsys):
    reload.setattr(cpu, "LIBRARY", tmp_path / "_engine.so")
    for engine in ("auto", "cpu"):
        with pytest.raises(SarsplatError, match=r"the CPU engine cannot be loaded \(.*_engine.so.*engine='reference'"):
            render(GAUSSIANS, VIEWS, GRID, engine=engine)
    assert render(GAUSSIANS, VIEWS, GRID, engine="reference").images.sum() > 0
    assert main(["doctor"]) == 0
    assert "the CPU engine cannot be loaded" in " ".join(capsys.readouterr().out.split())


def test_a_library_of_other_sources(reload):
    reload.setitem(cpu._ARGUMENTS, "of_tomorrow", ())
    with pytest.raises(SarsplatError, match=r"no sg_of_tomorrow, which this version .* reinstall with `pip"):
        render(GAUSSIANS, VIEWS, GRID, engine="cpu")
