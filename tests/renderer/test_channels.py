"""Several channels to a Gaussian from a law of scattering of one's own, and what a rendering says of itself."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from compared import check_agreement, differentiated
from named_scenes import GRID, VIEWS, cloud
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Ground, NormalLobes
from sarsplat.renderer import channel_of, render


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
