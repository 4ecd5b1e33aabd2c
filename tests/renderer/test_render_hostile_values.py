"""NaN, infinities, denormals and giants in any input: refused by name, or proven harmless."""

import math
import random
import struct

import pytest
import torch
from named_scenes import Scene, cloud

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MIN_SCALE
from sarsplat.renderer import render
from sarsplat.renderer.engines import cpu

ENGINES = [("cpu", name) for name in cpu.instruction_sets()] + [("reference", "auto")]
TINY, MIN_NORMAL, LARGEST = 1e-45, 1.1754944e-38, 3.4028234e38


def _random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


SCENE = Scene(cloud(12, 0, size=(1.0, 1.0, 1.0)), shift=0.1 * _random(1, 3, 2), gain=torch.tensor([1.3, 0.7, 2.0]))
DIRECT = Scene(cloud(12, 0, size=(1.0, 1.0, 1.0)), amplitudes=_random(2, 3, 12, 1).abs())
ARGUMENTS = ["means", "quaternions", "scales", "optical_depth", "scattering", "shift", "gain", "amplitudes"]


def with_value(argument: str, index: int, value: float, engine: str) -> tuple[Scene, dict[str, torch.Tensor]]:
    """The scene with one number of one argument replaced, as leaves of the engine's dtype."""
    scene = DIRECT if argument == "amplitudes" else SCENE
    leaves = scene.leaves(torch.float32 if engine == "cpu" else torch.float64)
    with torch.no_grad():
        leaves[argument].view(-1)[index % leaves[argument].numel()] = value
    return scene, leaves


def run(scene: Scene, leaves: dict[str, torch.Tensor], engine: str, instruction_set: str) -> list[torch.Tensor]:
    """Images, cross-sections and all gradients."""
    rendering = scene.call(render, leaves, engine=engine, instruction_set=instruction_set)
    outputs = [rendering.images, rendering.cross_sections]
    generator = torch.Generator().manual_seed(3)
    loss = sum((output * torch.randn(output.shape, generator=generator)).sum() for output in outputs)
    gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    return [*(output.detach() for output in outputs), *(g for g in gradients if g is not None)]


@pytest.mark.parametrize(("engine", "instruction_set"), ENGINES)
@pytest.mark.parametrize("argument", ARGUMENTS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused_by_name(argument, value, engine, instruction_set):
    for index in (0, 7):
        with pytest.raises(SarsplatError, match=rf"^{argument}\[.*\] is .*(nan|inf).*; it must be "):
            run(*with_value(argument, index, value, engine), engine, instruction_set)


@pytest.mark.parametrize(("engine", "instruction_set"), ENGINES)
@pytest.mark.parametrize("argument", [name for name in ARGUMENTS if name != "scales"])
@pytest.mark.parametrize("value", [TINY, MIN_NORMAL, -0.0])
def test_denormals_are_zeros(argument, value, engine, instruction_set):
    """What lies below the least normal number changes nothing, in values or gradients."""
    found = run(*with_value(argument, 7, value, engine), engine, instruction_set)
    expected = run(*with_value(argument, 7, 0.0, engine), engine, instruction_set)
    for mine, theirs in zip(found, expected, strict=True):
        assert torch.isfinite(mine).all()
        assert float((mine - theirs).norm()) <= 1e-6 * float(theirs.norm())


NUMBERS = [0.0, TINY, MIN_NORMAL, MIN_SCALE, 1e9, 1e15, LARGEST, -LARGEST, 1e-20, 1e20, -1.0, 1.0]


@pytest.mark.parametrize(("engine", "instruction_set"), ENGINES)
@pytest.mark.parametrize("argument", ARGUMENTS)
def test_any_number_is_refused_by_name_or_gives_finite_results(argument, engine, instruction_set):
    rng, large = random.Random(argument), 5.0 if argument == "scales" else 40.0
    for value in [*NUMBERS, large, *struct.unpack("8f", rng.randbytes(32))]:
        scene, leaves = with_value(argument, rng.randrange(200), value, engine)
        try:
            results = run(scene, leaves, engine, instruction_set)
        except SarsplatError as error:
            words = ("too many rays", "needs rays", "pairs") if argument in ("means", "scales") else ()
            assert str(error).startswith(f"{argument}[") or any(word in str(error) for word in words), (value, error)
        else:
            assert all(torch.isfinite(result).all() for result in results), value


def test_a_cotangent_that_is_not_finite_stays_in_its_view():
    leaves = DIRECT.leaves(torch.float32)
    images = DIRECT.call(render, leaves, engine="cpu").images
    seed = torch.ones_like(images)
    seed[0].view(-1)[images[0].argmax()] = math.nan
    (gradient,) = torch.autograd.grad(images, [leaves["amplitudes"]], seed, retain_graph=True)
    assert torch.isnan(gradient[0]).any()
    assert torch.isfinite(gradient[1:]).all()
    (gradient,) = torch.autograd.grad(images, [leaves["amplitudes"]], torch.ones_like(images))  # the next call is clean
    assert torch.isfinite(gradient).all()


def test_the_scenes_are_seen():
    """Otherwise nothing above could go wrong."""
    for scene in (SCENE, DIRECT):
        results = run(scene, scene.leaves(torch.float32), "cpu", "auto")
        assert all(float(result.norm()) > 0 for result in results)
