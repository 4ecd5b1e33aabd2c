"""An echo of one's own is one class: it is told what a rendering knows, and is added to the images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest
import torch
from compared import check_agreement, differentiated
from emulated_cuda import Emulator, render_on
from named_scenes import GRID, VIEWS, cloud
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import Footprints, project, render, splat
from sarsplat.renderer.echoes import Echo, Sighting


@dataclass(frozen=True)
class Haze(Echo):
    """Power that does not depend on the scene, except that it ends where rays do."""

    power: Tensor

    wants_ray_ends = True

    def check(self, gaussians: Gaussians) -> None:
        if gaussians.means.dtype == torch.float64:
            raise SarsplatError("haze is single")

    def values(self) -> dict[str, Tensor | None]:
        return {"haze.power": self.power.reshape(1)}

    def returned(self, sighting: Sighting) -> Tensor:
        assert sighting.ends is not None
        rays = [rows * columns for rows, columns in sighting.ends.sizes]
        left = torch.stack([part.mean() for part in sighting.ends.transmittance.split(rays)])
        return (self.power * left)[:, None, None].expand(-1, sighting.grid.rows, sighting.grid.columns)


class Glow(Echo):
    """Power that grows with the square of the areas over which Gaussians are seen."""

    def returned(self, sighting: Sighting) -> Tensor:
        glow = sighting.lit_area.square().sum(1)
        return glow[:, None, None].expand(-1, sighting.grid.rows, sighting.grid.columns)


@dataclass(frozen=True)
class Mirrored(Echo):
    """Every Gaussian once more, at the range of its foot, with this share of the area over which it is seen."""

    share: float

    def visible(self, gaussians: Gaussians) -> Gaussians:
        return replace(gaussians, optical_depth=gaussians.optical_depth * 0.5)

    def in_sight(
        self, means: Tensor, views: Sequence[View], grid: ImageGrid, rays: RayGrid, shift: Tensor | None
    ) -> Tensor:
        return (means[:, 0] > -0.5).to(means).expand(len(views), -1)

    def returned(self, sighting: Sighting) -> Tensor:
        s = sighting
        feet = s.gaussians.means * s.gaussians.means.new_tensor([1.0, 1.0, 0.0])
        p = project(replace(s.gaussians, means=feet), s.views, s.grid, rays=s.rays, shift=s.shift)
        sections = p.amplitudes[..., :1] * (self.share * s.lit_area.detach())[..., None]
        return 2 * splat(Footprints(p.pixels.centers, p.pixels.roots), sections, s.grid)[:, 0]


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_echoes_are_added_to_the_images_and_given_one_by_one(engine: str) -> None:
    scene, rays = cloud(40, 30), RayGrid.for_image(GRID)
    ground = Ground(torch.tensor(0.3), height_m=-0.55)
    haze = Haze(torch.tensor(0.2, requires_grad=True))
    alone = render(scene, VIEWS, GRID, rays=rays, ground=ground, engine=engine)
    both = render(
        scene, VIEWS, GRID, rays=rays, ground=ground, echoes=[haze], gain=torch.ones(len(VIEWS)), engine=engine
    )
    assert len(alone.echoes) == 1 and len(both.echoes) == 2
    torch.testing.assert_close(both.ground, both.echoes[0])
    torch.testing.assert_close(both.images[:, 0], alone.images[:, 0] + both.echoes[1])
    assert 0 < float(both.echoes[1].detach().min()) < 0.2  # something ends rays
    both.images.sum().backward()
    assert haze.power.grad is not None
    torch.testing.assert_close(haze.power.grad, both.echoes[1].detach().sum() / 0.2, rtol=1e-4, atol=0)


def test_an_echo_may_hide_and_return_what_is_behind() -> None:
    scene = cloud(40, 31)
    found = {
        engine: render(scene, VIEWS, GRID, echoes=[Mirrored(0.25)], engine=engine) for engine in ("cpu", "reference")
    }
    thin = replace(scene, optical_depth=torch.where(scene.means[:, 0] > -0.5, scene.optical_depth * 0.5, 0.0))
    expected = render(thin, VIEWS, GRID)
    for rendering in found.values():
        torch.testing.assert_close(rendering.lit_area, expected.lit_area, rtol=1e-4, atol=1e-6)
        (mirrored,) = rendering.echoes
        torch.testing.assert_close(rendering.images, expected.images + mirrored[:, None], rtol=1e-3, atol=1e-5)
        total = float(mirrored.sum()) * GRID.spacing_m[0] * GRID.spacing_m[1]
        assert total == pytest.approx(0.5 * float(expected.cross_sections.sum()), rel=0.1)


def test_what_does_not_fit_is_refused() -> None:
    scene = cloud(3, 0)
    with pytest.raises(SarsplatError, match="haze is single"):
        render(scene.to(torch.float64), VIEWS, GRID, echoes=[Haze(torch.tensor(1.0))])
    with pytest.raises(SarsplatError, match="gives images without a unit"):
        render(scene, VIEWS, GRID, echoes=[Haze(torch.tensor(1.0))], imaging_weight="peak")
    for engine in ("cpu", "reference"):
        with pytest.raises(SarsplatError, match=r"haze\.power"):
            render(scene, VIEWS, GRID, echoes=[Haze(torch.tensor(torch.nan))], engine=engine)


@pytest.mark.parametrize("engine", ["cpu", "reference"])
@pytest.mark.parametrize(
    ("method", "wrong", "message"),
    [
        (
            "in_sight",
            lambda self, means, *_: torch.ones(len(means)),
            r"in_sight gave torch.float32 \(3,\); it must give a tensor",
        ),
        ("in_sight", lambda self, means, *_: 1.0, "in_sight gave float"),
        ("visible", lambda self, gaussians: gaussians[:2], "visible makes 3 Gaussians to 2"),
        ("returned", lambda self, _: torch.ones(GRID.rows, GRID.columns), r"returned gave torch.float32 .* must"),
        ("returned", lambda self, s: s.lit_area.new_zeros(3, GRID.rows, GRID.columns).double(), "torch.float64"),
        ("returned", lambda self, _: None, "returned gave NoneType"),
    ],
)
def test_what_an_echo_gets_wrong_is_said(engine: str, method: str, wrong: object, message: str) -> None:
    own = type("Own", (Mirrored,), {method: wrong})(0.5)
    with pytest.raises(SarsplatError, match=message):
        render(cloud(3, 0), VIEWS, GRID, echoes=[own], engine=engine)


def test_lit_areas_that_echoes_are_told_are_differentiable(library: Path) -> None:
    expected, *others = (
        differentiated(cloud(12, 0), dtype, lambda scene, by=by: by(scene, VIEWS, GRID, echoes=[Glow()]).images)
        for dtype, by in (
            (torch.float64, partial(render, engine="reference")),
            (torch.float32, render),
            (torch.float32, partial(render_on, Emulator(library))),
        )
    )
    for found in others:
        check_agreement(found, expected)
