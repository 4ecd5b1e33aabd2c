"""Laws inside the engines: γ⁰ in a lobe against the law itself in float64, and several channels to a Gaussian."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import pytest
import torch
from compared import check_agreement, differentiated
from emulated_cuda import Emulator
from named_scenes import GRID, VIEWS, cloud
from torch import Tensor

from sarsplat import Gaussians, Ground, NormalLobes, SarsplatError, View
from sarsplat.renderer import channel_of, operations, render
from sarsplat.renderer.engines import cpu, cuda
from sarsplat.renderer.engines.problem import directions_to

AROUND = [View(20.0 * k, 5.0 + 9.0 * k) for k in range(9)]

Towards = Callable[[Gaussians, Sequence[View]], torch.Tensor]


@pytest.fixture(params=["cpu", "cuda"])
def amplitudes_towards(request: pytest.FixtureRequest) -> Towards:
    """By one of the engines."""
    if request.param == "cpu":
        return partial(operations.amplitudes_towards, cpu.Pass)
    return partial(operations.amplitudes_towards, partial(cuda.Pass, Emulator(request.getfixturevalue("library"))))


def gaussians(count: int, log_exponent: tuple[float, float] = (0.0, 3.5), seed: int = 0) -> Gaussians:
    """Every third Gaussian has two shortest axes, of which the first is its normal."""
    generator = torch.Generator().manual_seed(seed)
    scales = torch.rand(count, 3, generator=generator) + 0.02
    scales[::3, 2] = scales[::3, 1].clamp(max=scales[::3, 0])
    scales[::3, 1] = scales[::3, 2]
    parameters = 3 * torch.randn(count, 3, generator=generator)
    low, high = log_exponent
    parameters[:, 2] = low + (high - low) * torch.rand(count, generator=generator)
    return Gaussians(
        torch.randn(count, 3, generator=generator),
        torch.randn(count, 4, generator=generator).requires_grad_(),
        scales.requires_grad_(),
        torch.ones(count),
        NormalLobes(parameters.requires_grad_(), 0.03),
    )


def double(scene: Gaussians) -> Gaussians:
    """The same in float64, with gradients of its own."""
    double = scene.detach().to(torch.float64)
    return double.with_tensors(**{name: tensor.requires_grad_() for name, tensor in double.tensors().items()})


@pytest.mark.parametrize("log_exponent", [(0.7, 0.7), (0.0, 3.5), (-8.0, 8.0)])
@pytest.mark.parametrize("count", [0, 1, 37, 2100])
def test_values_and_gradients_are_those_of_the_law(count, log_exponent, amplitudes_towards):
    scene = gaussians(count, log_exponent)
    judge = double(scene)
    found, wanted = amplitudes_towards(scene, AROUND), judge.amplitudes(directions_to(AROUND, judge.means))
    rounding = 5e-6 + 5e-7 * math.exp(min(log_exponent[1], 5.0))  # a sharp lobe multiplies that of the cosine
    torch.testing.assert_close(found.double(), wanted, rtol=rounding, atol=1e-6)
    assert "_Call" in type(found.grad_fn).__name__  # not the law, in torch, which takes several times as long
    cotangent = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (found * cotangent.float()).sum().backward()
    (wanted * cotangent).sum().backward()
    assert scene.scales.grad is None  # which axis is the shortest is held constant
    ours, true = scene.scattering.parameters.grad, judge.scattering.parameters.grad
    pairs = [*zip(ours.T, true.T), (scene.quaternions.grad, judge.quaternions.grad)]
    for ours, true in pairs:
        size = true.abs().max().item() if count else 0.0
        torch.testing.assert_close(ours.double(), true, rtol=2 * rounding, atol=1e-6 + 1e-6 * size)


def test_edge_on(amplitudes_towards: Towards) -> None:
    """A cosine of zero has no logarithm, and slopes against it are finite all the same."""
    logs = (-9.0, 0.0, 0.7, 1.0, 3.0, 9.0)
    n = len(logs)
    quaternions = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1).requires_grad_()
    view = View(0.0, 30.0)
    across = int(abs(view.direction).argmin())
    scales = torch.full((n, 3), 0.2)
    scales[:, across] = 0.1
    parameters = torch.tensor([[0.0, 1.0, log] for log in logs], requires_grad=True)
    scene = Gaussians(torch.zeros(n, 3), quaternions, scales, torch.ones(n), NormalLobes(parameters, 0.1))
    found = amplitudes_towards(scene, [view])
    torch.testing.assert_close(found[0, 1:, 0], torch.full((n - 1,), 0.1 + math.log(2)), atol=1e-5, rtol=0)
    found.sum().backward()
    assert quaternions.grad.isfinite().all() and parameters.grad.isfinite().all()


def test_what_is_no_number_stays_that(amplitudes_towards: Towards) -> None:
    """A training that has gone wrong is to say so."""
    scene = gaussians(12)
    for column in range(3):
        scene.scattering.parameters.detach()[2 + 3 * column, column] = math.nan
    seen = amplitudes_towards(scene, AROUND)[..., 0].isnan()
    assert seen.all(0).nonzero()[:, 0].tolist() == [2, 5, 8]
    assert seen.any(0).sum() == 3


def test_a_law_derived_from_it_keeps_its_own_amplitudes(amplitudes_towards: Towards) -> None:
    class Doubled(NormalLobes):
        def amplitudes(self, *arguments: torch.Tensor) -> torch.Tensor:
            return 2 * super().amplitudes(*arguments)

    scene = gaussians(4)
    doubled = replace(scene, scattering=Doubled(scene.scattering.parameters, scene.scattering.p_min))
    torch.testing.assert_close(amplitudes_towards(doubled, AROUND), 2 * amplitudes_towards(scene, AROUND))


@pytest.mark.parametrize("count", [50, 5000])
def test_rows_and_cotangents_that_are_not_contiguous(count: int, amplitudes_towards: Towards) -> None:
    """Copied for the engine, and kept until the engine has read them."""
    scene = gaussians(count)
    strided = replace(scene, quaternions=scene.quaternions.detach().T.contiguous().T)
    assert torch.equal(amplitudes_towards(strided, AROUND), amplitudes_towards(scene, AROUND))
    leaves = scene.quaternions, scene.scattering.parameters
    cotangent = torch.randn(count, generator=torch.Generator().manual_seed(2)).expand(len(AROUND), -1)[..., None]
    found = torch.autograd.grad(amplitudes_towards(scene, AROUND), leaves, cotangent)
    wanted = torch.autograd.grad(amplitudes_towards(scene, AROUND), leaves, cotangent.contiguous())
    assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))


# ---- several channels, and what a rendering says of itself -----------------------------------------------------------
@dataclass(frozen=True)
class TwoPolarisations(NormalLobes):
    """Power in the second channel; in the first, what tells the lobes from the rest, of either sign."""

    kind: ClassVar[str] = "two-polarisations"
    channels: ClassVar[tuple[str, ...]] = ("difference", "power")
    power_channel: ClassVar[int] = 1

    def amplitudes(self, directions: Tensor, quaternions: Tensor, scales: Tensor) -> Tensor:
        power = super().amplitudes(directions, quaternions, scales)
        return torch.cat([power - self.parameters[:, :1].square(), power], dim=2)


LAW = TwoPolarisations(torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), 0.05)
SCENE = replace(cloud(40, 3), scattering=LAW)


def test_a_law_of_two_channels_from_end_to_end():
    found, expected = (
        differentiated(SCENE, dtype, lambda scene, by=engine: render(scene, VIEWS, GRID, engine=by).images)
        for engine, dtype in (("cpu", torch.float32), ("reference", torch.float64))
    )
    assert found["image"].shape == (len(VIEWS), 2, GRID.rows, GRID.columns)
    check_agreement(found, expected)
    assert torch.equal(SCENE.gamma0(torch.eye(3)), SCENE.amplitudes(torch.eye(3))[..., 1])


def test_the_ground_returns_power_alone():
    ground = Ground(torch.tensor(0.3), height_m=-1.0)
    alone, both = render(SCENE, VIEWS, GRID), render(SCENE, VIEWS, GRID, ground=ground)
    assert torch.equal(both.images[:, 0], alone.images[:, 0])
    torch.testing.assert_close(both.images[:, 1], alone.images[:, 1] + both.ground)


def test_one_channel_of_a_rendering():
    made = render(SCENE, VIEWS, GRID)
    assert torch.equal(made.channel(1), made.images[:, 1])
    for missing in (2, -1):
        with pytest.raises(SarsplatError, match=rf"no channel {missing} in images of 2; give one from 0 to 1"):
            channel_of(made.images, missing)


def test_a_rendering_prints_shapes_and_no_tensors():
    rendering = render(cloud(10, 0), VIEWS[:2], GRID, first_return_depth=0.5, plane_gradients=True)
    rays = [list(ray_map.transmittance.shape) for ray_map in rendering.ray_maps]
    assert repr(rendering) == (
        f"Rendering(images=[2, 1, {GRID.rows}, {GRID.columns}], cross_sections=[2, 10, 1], lit_area=[2, 10], "
        f"plane_gradients=[2, 10, 4], ray_maps={rays}, torch.float32 on cpu)"
    )
