"""Several channels to a Gaussian from a law of scattering of one's own, and what a rendering says of itself."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from named_scenes import GRID, VIEWS, cloud
from test_cpu_engine import relative
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, NormalLobes
from sarsplat.renderer import Rendering, channel_of, render


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
