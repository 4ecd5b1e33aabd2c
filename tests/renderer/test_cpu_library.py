"""Loading the CPU engine: without torch's threads it works on one; without the library the reference still renders."""

import pytest
import torch

from made import upright
from sarsplat.cli import main
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import ImageGrid, View
from sarsplat.renderer import render
from sarsplat.renderer.engines import cpu

GAUSSIANS = upright([1.0, 1.0, 1.0])
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


def test_a_library_of_other_sources(reload, tmp_path):
    other = tmp_path / "api.h"
    other.write_bytes(cpu.HEADER.read_bytes() + b"\n")
    reload.setattr(cpu, "HEADER", other)
    with pytest.raises(SarsplatError, match=r"other structures or functions than this version .* reinstall with `pip"):
        render(GAUSSIANS, VIEWS, GRID, engine="cpu")


def test_a_library_of_a_time_before_there_was_a_digest(reload):
    reload.setattr(cpu, "LIBRARY", cpu.torch.__file__.replace("__init__.py", "lib/libc10.so"))
    with pytest.raises(SarsplatError, match="other structures or functions than this version"):
        render(GAUSSIANS, VIEWS, GRID, engine="cpu")


class Partial:
    """The engine as if compiled for some instruction sets, on a processor that supports those up to a number."""

    def __init__(self, supported: int, *compiled: int) -> None:
        self._engine, self._compiled = cpu.library(), compiled
        self.sg_supported_isa = lambda: supported

    def sg_engine_for(self, isa: int) -> object:
        return isa in self._compiled

    def __getattr__(self, name: str):
        return getattr(self._engine, name)


@pytest.mark.parametrize(
    ("supported", "compiled", "asked", "refused"),
    [
        (2, (1, 2, 3), "avx512", "'avx512' is not supported by this processor; use 'auto' or at most 'avx2'"),
        (2, (2,), "avx512", "'avx512' is not supported by this processor; use 'auto' or at most 'avx2'"),
        (3, (3,), "avx2", r"not compiled for the instruction set 'avx2'; `python build_engine\.py` compiles it"),
        (2, (3,), "auto", "not compiled for this processor; `python"),
        (2, (3,), "base", "not compiled for the instruction set 'base'; `python"),
    ],
)
def test_an_instruction_set_that_is_not_there(monkeypatch, supported, compiled, asked, refused):
    partial = Partial(supported, *compiled)
    monkeypatch.setattr(cpu, "library", lambda: partial)
    with pytest.raises(SarsplatError, match=refused):
        render(GAUSSIANS, VIEWS, GRID, engine="cpu", instruction_set=asked)
    with pytest.raises(SarsplatError, match=refused):
        cpu.Pass(asked)


def test_the_widest_instruction_set_that_is_there_is_used(monkeypatch):
    for supported, compiled, best in ((3, (1, 2, 3), "avx512"), (3, (1,), "base"), (2, (1, 2, 3), "avx2")):
        partial = Partial(supported, *compiled)
        monkeypatch.setattr(cpu, "library", lambda partial=partial: partial)
        assert cpu.best_instruction_set() == best
