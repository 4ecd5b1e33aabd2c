"""Engines: one place decides which does what; their declarations in C; and how the CPU's library is loaded."""

import ctypes
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from named_scenes import GRID, MATRIX, VIEWS, cloud

from made import upright
from sarsplat import ImageGrid, NormalLobes, RayGrid, SarsplatError, SarsplatWarning, Stack, View
from sarsplat.cli import main
from sarsplat.renderer import attenuate, project, render, render_covariances, splat
from sarsplat.renderer.covariances import Sections
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.renderer.engines.abi import HEADER, SOURCES, api, filled, members_of, structure_of, structures
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.cuda_operations import OPERATIONS
from sarsplat.renderer.engines.operation import Operation

RAYS = RayGrid.for_image(GRID)
CHOICES = "auto, cpu, cpu-base, cpu-avx2, cpu-avx512, cuda, reference"
LACKED = "engine='cpu-avx512' needs an instruction set that this processor lacks; use 'cpu' or at most 'cpu-avx2'"


def lobes() -> Any:
    scene = cloud(20, 0)
    return replace(scene, scattering=NormalLobes(torch.zeros(20, 3)))


def steps() -> torch.Tensor:
    projection = project(lobes(), VIEWS, GRID, engine="reference")
    lit_area = attenuate(projection, RAYS, engine="reference").lit_area
    return splat(projection.pixels, projection.amplitudes * lit_area[..., None], GRID, engine="reference")


def of_the_matrix(name: str) -> Callable[[], torch.Tensor]:
    scene = MATRIX[name]()
    return lambda: scene.call(render, scene.leaves(torch.float32), engine="reference").images


CALLS = {
    "lobes": lambda: render(lobes(), VIEWS, GRID, engine="reference").images,
    "steps": steps,
    "stacks": lambda: render_covariances(lobes(), VIEWS, GRID, Stack(0.03, (0.0, 0.01)), engine="reference").abs(),
    **{name: of_the_matrix(name) for name in MATRIX if "ground" in name or "terrain" in name},
}


@pytest.mark.parametrize("name", CALLS)
def test_the_reference_calls_no_engine(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In float32 on the CPU, where there is a kernel for everything."""

    def called(*_: object) -> None:
        raise AssertionError("the reference called an engine")

    monkeypatch.setattr(cpu.Pass, "__init__", called)
    monkeypatch.setattr(cuda.Pass, "__init__", called)
    assert CALLS[name]().sum() > 0


def declared() -> list[type[Operation]]:
    return [one for one in Operation.__subclasses__() if one.__module__.startswith("sarsplat.")]


def test_every_operation_of_the_header_is_declared_in_python_once() -> None:
    listed = [line.split("_(")[1].split(",")[0] for line in HEADER.read_text().splitlines() if line.startswith("  _(")]
    assert sorted(listed) == sorted(["adam", *(one.operation for one in declared())])  # which steps in place
    assert OPERATIONS.keys() < set(listed)
    for one in declared():
        members = members_of(structure_of(one.operation)).keys()
        assert set(one.names) < members
        assert any(f"d_{name}" in members for name in one.names)


def test_who_does_what() -> None:
    single, double = (torch.zeros(3, dtype=dtype) for dtype in (torch.float32, torch.float64))
    assert isinstance(passes_for("auto", {"x": None, "y": single})(), cpu.Pass)
    assert passes_for("auto", {"x": double}) is None
    assert passes_for("auto", {"x": torch.zeros(3, device="meta")}) is None
    assert passes_for("reference", {"x": single}) is None
    with pytest.raises(SarsplatError, match=r"y is torch.float64 on cpu; the CPU engine takes torch.float32"):
        passes_for("auto", {"x": single, "y": double})
    with pytest.raises(SarsplatError, match=f"engine 'gpu' is unknown; choose one of {CHOICES}"):
        passes_for("gpu", {"x": single})


def test_what_an_engine_has_not_is_left_to_plain_torch() -> None:
    """Of numbers that it does not take, too."""
    cpus, gpus = cpu.Pass(), cuda.Pass(None)
    for one in declared():
        assert cpus.has(one.operation, {"passes": 16})
    assert not cpus.has("stack_likelihood", {"passes": 17})
    assert not cpus.has("no such kernel", {})
    assert gpus.has("lit_ground", {}) and not gpus.has("stack_likelihood", {})
    assert [gpus.has("adam", {"columns": columns}) for columns in (16, 17)] == [True, False]


def test_the_twin_runs() -> None:
    """Of an operation that GPUs do not have."""
    shapes = (5, 3), (5, 4), (5, 3), (2, 3, 3), (2, 5, 3), (2, 4), (2, 5, 1)
    inputs = [*(torch.rand(shape) for shape in shapes), None]
    expected = Sections().plain(*inputs)
    for new_pass in (None, lambda: cuda.Pass(None)):
        assert all(torch.equal(*both) for both in zip(Sections().on(new_pass, *inputs), expected, strict=True))


# ---- what Python reads of the C declarations is what a compiler makes of them ----------------------------------------
def test_structures_lie_as_a_compiler_lays_them(tmp_path: Path) -> None:
    pytest.importorskip("ziglang", reason="compiled with ziglang")
    said = [f'#include "{HEADER}"', "#include <cstddef>"]
    for name, one in vars(api).items():
        said.append(f"static_assert(sizeof(sg_{name}) == {ctypes.sizeof(one)});")
        said += [f"static_assert(offsetof(sg_{name}, {of}) == {getattr(one, of).offset});" for of, _ in one._fields_]
        said += [f"static_assert(sizeof(((sg_{name}*)0)->{of}) == {getattr(one, of).size});" for of, _ in one._fields_]
    assert len(said) > 300
    source = tmp_path / "layouts.cpp"
    source.write_text("\n".join(said))
    command = [sys.executable, "-m", "ziglang", "c++", "-std=c++17", "-c", source, "-o", tmp_path / "layouts.o"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_structure_and_no_function_is_overlooked() -> None:
    text = HEADER.read_text()
    assert len(vars(api)) == text.count("\nstruct sg_") - text.count("\nstruct sg_context;")
    functions = dict(api.engine._fields_)
    assert [len(functions[name]._argtypes_) for name in ("create", "render", "trace", "splat_backward")] == [0, 4, 6, 7]
    assert functions["create"]._restype_ is ctypes.c_void_p
    assert functions["statistics"]._restype_ is None
    assert functions["lit_ground"]._argtypes_ == (ctypes.c_void_p, ctypes.POINTER(api.ground))
    members = members_of(api.bounce)
    assert (members["lattices"], members["offset"]) == (ctypes.POINTER(api.lattice), ctypes.c_void_p)
    assert list(structures((SOURCES / "cuda_state.cuh").read_text(), ["Lattice"])) == ["Lattice"]


def test_a_structure_is_filled() -> None:
    lit, places = torch.empty(2, 3), [{"rows": (0.5, 2.0, 3), "columns": (1.0, 1.5, 4)}] * 2
    call = filled(
        structure_of("lit_ground"), {"views": 2, "std": (0.25, 0.5), "patches": places, "lit": lit, "shift": None}
    )
    assert (call.views, tuple(call.std), call.lit, call.shift) == (2, (0.25, 0.5), lit.data_ptr(), None)
    assert (call.patches[1].rows.step, call.patches[1].columns.count) == (2.0, 4)


# ---- loading the CPU engine ------------------------------------------------------------------------------------------
GAUSSIANS = upright([1.0, 1.0, 1.0])
AROUND = [View(azimuth, 40.0) for azimuth in range(0, 360, 15)]
WIDE = ImageGrid(64, 64, (0.3, 0.3), (0.3, 0.3))


@pytest.fixture
def reload(monkeypatch: pytest.MonkeyPatch):
    """Loads the engine anew, in the test and after it."""
    cpu.library.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    cpu.library.cache_clear()
    cpu.library()


def test_without_the_threads_of_torch_the_engine_runs_on_one_and_doctor_says_so(reload, capsys):
    expected = render(GAUSSIANS, AROUND, WIDE, engine="cpu").images
    assert main(["doctor"]) == 0
    assert "on the threads of PyTorch" in " ".join(capsys.readouterr().out.split())
    for library in ("libnothing.so", "libc10.so"):  # no such library; a library without the function
        reload.setattr(cpu, "_TORCH", library)
        cpu.library.cache_clear()
        with pytest.warns(SarsplatWarning, match=r"runs on one thread, because PyTorch .* has no torch_parallel_for"):
            assert torch.equal(render(GAUSSIANS, AROUND, WIDE, engine="cpu").images, expected)
        assert torch.equal(render(GAUSSIANS, AROUND, WIDE, engine="cpu").images, expected)  # which is said once
        assert main(["doctor"]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert f"on one thread, because PyTorch {torch.__version__} has no torch_parallel_for" in said


def test_without_the_library_the_reference_still_renders(reload, tmp_path, capsys):
    reload.setattr(cpu, "LIBRARY", tmp_path / "_engine.so")
    for engine in ("auto", "cpu"):
        with pytest.raises(SarsplatError, match=r"the CPU engine cannot be loaded \(.*_engine.so.*engine='reference'"):
            render(GAUSSIANS, AROUND, WIDE, engine=engine)
    assert render(GAUSSIANS, AROUND, WIDE, engine="reference").images.sum() > 0
    assert main(["doctor"]) == 0
    assert "the CPU engine cannot be loaded" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", ["HEADER", "LIBRARY"])
def test_a_library_of_other_sources_or_without_a_digest(reload, tmp_path, name):
    (other := tmp_path / "api.h").write_bytes(cpu.HEADER.read_bytes() + b"\n")
    reload.setattr(cpu, name, other if name == "HEADER" else cpu.torch.__file__.replace("__init__.py", "lib/libc10.so"))
    with pytest.raises(SarsplatError, match=r"other structures or functions than this version .* reinstall with `pip"):
        render(GAUSSIANS, AROUND, WIDE, engine="cpu")


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
        (2, (1, 2, 3), "avx512", LACKED),
        (2, (2,), "avx512", LACKED),
        (3, (3,), "avx2", r"not compiled for the instruction set 'avx2'; `python build_engine\.py` compiles it"),
        (2, (3,), "auto", "not compiled for this processor; `python"),
        (2, (3,), "base", "not compiled for the instruction set 'base'; `python"),
    ],
)
def test_an_instruction_set_that_is_not_there(monkeypatch, supported, compiled, asked, refused):
    partial = Partial(supported, *compiled)
    monkeypatch.setattr(cpu, "library", lambda: partial)
    with pytest.raises(SarsplatError, match=refused):
        render(GAUSSIANS, AROUND, WIDE, engine="cpu" if asked == "auto" else f"cpu-{asked}")
    with pytest.raises(SarsplatError, match=refused):
        cpu.Pass(asked)


def test_the_widest_instruction_set_that_is_there_is_used(monkeypatch):
    for supported, compiled, best in ((3, (1, 2, 3), "avx512"), (3, (1,), "base"), (2, (1, 2, 3), "avx2")):
        partial = Partial(supported, *compiled)
        monkeypatch.setattr(cpu, "library", lambda partial=partial: partial)
        assert cpu.best_instruction_set() == best
