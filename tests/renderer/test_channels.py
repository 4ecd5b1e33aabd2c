"""Several channels to a Gaussian: in the reference, in the CPU engine, and from a law of scattering of one's own."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from named_scenes import GRID, VIEWS, cloud
from test_cpu_engine import AVAILABLE, relative
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, NormalLobes
from sarsplat.geometry import ImageGrid
from sarsplat.renderer import Rendering, channel_of, render

ODD = ImageGrid(19, 23, spacing_m=(0.2, 0.21), resolution_m=(0.3, 0.4))


def run(
    gaussians: Gaussians, amplitudes: Tensor, dtype: torch.dtype = torch.float32, instruction_set: str = "auto"
) -> list[Tensor]:
    """Images, cross-sections and the gradients of both, by random cotangents."""
    fields = {name: t.detach().to(dtype).requires_grad_() for name, t in gaussians.tensors().items()}
    leaves = [*(t for name, t in fields.items() if name != "scattering"), amplitudes.to(dtype).requires_grad_()]
    engine = "cpu" if dtype == torch.float32 else "reference"
    made = render(
        gaussians.with_tensors(**fields),
        VIEWS,
        ODD,
        amplitudes=leaves[-1],
        engine=engine,
        instruction_set=instruction_set,
    )
    generator = torch.Generator().manual_seed(7)
    seeds = [torch.randn(t.shape, generator=generator).to(dtype) for t in (made.images, made.cross_sections)]
    gradients = torch.autograd.grad((made.images, made.cross_sections), leaves, seeds)
    return [t.detach() for t in (made.images, made.cross_sections, *gradients)]


def amplitudes_of(count: int, channels: int) -> Tensor:
    amplitudes = torch.randn(len(VIEWS), count, channels, generator=torch.Generator().manual_seed(channels))
    amplitudes[:, ::7] = 0.0  # dark in every channel
    return amplitudes


@pytest.mark.parametrize("instruction_set", AVAILABLE)
@pytest.mark.parametrize("channels", [1, 2, 3, 5, 8, 9, 16])
def test_engine_and_reference_agree(channels, instruction_set):
    gaussians, amplitudes = cloud(60, 5), amplitudes_of(60, channels)
    engine = run(gaussians, amplitudes, instruction_set=instruction_set)
    for mine, expected in zip(engine, run(gaussians, amplitudes, torch.float64), strict=True):
        assert expected.norm() > 0
        assert relative(mine, expected) <= 3e-5


def test_every_channel_is_the_image_of_its_own_amplitudes():
    gaussians, amplitudes = cloud(300, 5), amplitudes_of(300, 5)
    together = run(gaussians, amplitudes)
    alone = [run(gaussians, amplitudes[..., c : c + 1]) for c in range(5)]
    assert torch.equal(together[0], torch.cat([each[0] for each in alone], dim=1))
    assert torch.equal(together[1], torch.cat([each[1] for each in alone], dim=2))


@pytest.mark.parametrize("count", [0, 1])
def test_no_gaussian_and_one(count):
    images, sections, *gradients = run(cloud(count, 5), amplitudes_of(count, 3) + 1)
    assert images.shape == (len(VIEWS), 3, ODD.rows, ODD.columns)
    assert sections.shape == gradients[-1].shape == (len(VIEWS), count, 3)
    assert bool(images.any()) == bool(count)


@pytest.mark.parametrize("channels", [3, 16])
def test_bits_do_not_depend_on_threads(channels, threads):
    gaussians, amplitudes = cloud(3000, 5), amplitudes_of(3000, channels)
    runs = []
    for count in (1, 2, 3):
        threads(count)
        runs.append(run(gaussians, amplitudes))
    for other in runs[1:]:
        assert all(torch.equal(one, two) for one, two in zip(runs[0], other, strict=True))


@dataclass(frozen=True)
class TwoPolarisations(NormalLobes):
    """Power in the second channel; in the first, what tells the lobes from the rest, of either sign."""

    kind: ClassVar[str] = "two-polarisations"
    channels: ClassVar[tuple[str, ...]] = ("difference", "power")
    power_channel: ClassVar[int] = 1

    def amplitudes(self, directions: Tensor, quaternions: Tensor, scales: Tensor) -> Tensor:
        power = super().amplitudes(directions, quaternions, scales)
        return torch.cat([power - self.parameters[:, :1].square(), power], dim=2)


def of_law(engine: str, dtype: torch.dtype) -> tuple[Gaussians, Rendering]:
    plain = cloud(40, 3)
    parameters = torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    law = TwoPolarisations(parameters.to(dtype).requires_grad_(), 0.05)
    geometry = {name: t.to(dtype) for name, t in plain.tensors().items() if name != "scattering"}
    gaussians = Gaussians(**geometry, scattering=law)
    return gaussians, render(gaussians, VIEWS, GRID, engine=engine)


def test_a_law_of_two_channels_from_end_to_end():
    results = []
    for engine, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        gaussians, made = of_law(engine, dtype)
        assert made.images.shape == (len(VIEWS), 2, GRID.rows, GRID.columns)
        seeds = torch.randn(made.images.shape, generator=torch.Generator().manual_seed(2)).to(dtype)
        (gradient,) = torch.autograd.grad(made.images, gaussians.scattering.parameters, seeds)
        results.append([made.images.detach(), gradient])
        directions = torch.eye(3, dtype=dtype)
        assert torch.equal(gaussians.gamma0(directions), gaussians.amplitudes(directions)[..., 1])
    for mine, expected in zip(*results, strict=True):
        assert relative(mine, expected) <= 3e-5


def test_one_channel_of_a_rendering():
    _, made = of_law("cpu", torch.float32)
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
