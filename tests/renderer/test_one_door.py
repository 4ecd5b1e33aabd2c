"""One place decides which engine does what; every kernel has a twin in plain torch, of which the reference consists."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from named_scenes import GRID, MATRIX, VIEWS, cloud

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import NormalLobes
from sarsplat.geometry import RayGrid, Stack
from sarsplat.renderer import attenuate, project, render, render_covariances, splat
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.renderer.engines.abi import HEADER, structure_of
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.cuda_operations import OPERATIONS
from sarsplat.renderer.engines.operation import Operation

RAYS = RayGrid.for_image(GRID)


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
        _, members = structure_of(one.operation)
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
    with pytest.raises(SarsplatError, match="engine 'gpu' is unknown; choose one of auto, cpu, cuda, reference"):
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


class Doubled(Operation):
    """An operation that no engine has."""

    operation = "doubled"
    names = ("x",)

    def plain(self, x: torch.Tensor) -> torch.Tensor:
        return 2 * x

    def numbers(self, x: torch.Tensor) -> dict[str, Any]:
        return {}

    def outputs(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        raise AssertionError


def test_the_twin_runs() -> None:
    for new_pass in (None, cpu.Pass, lambda: cuda.Pass(None)):
        assert Doubled().on(new_pass, torch.ones(2)).tolist() == [2.0, 2.0]
