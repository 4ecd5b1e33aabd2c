"""Echoes: by way of the ground against closed forms and the reference, and those of one's own, each one class."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest
import torch
from compared import check_agreement, check_gradients, differentiated, relative, without_cuts
from emulated_cuda import Emulator, render_on
from named_scenes import CLOUDS, FEW, GRID, UNUSUAL, VIEWS, cloud, few_pixels, random_normal, wall, with_scales
from test_cpu_engine import AVAILABLE
from torch import Tensor

from sarsplat import Gaussians, Ground, ImageGrid, RayGrid, SarsplatError, View
from sarsplat.renderer import Footprints, GroundBounce, Rendering, project, render, splat
from sarsplat.renderer.echoes import Echo, Sighting
from sarsplat.renderer.echoes.bounce import lit_both_ways
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.operations import Steps
from sarsplat.renderer.reference import pressed_flat_reference, render_reference

HEIGHT = -0.55
PIXEL = GRID.spacing_m[0] * GRID.spacing_m[1]
ONE = torch.tensor(1.0)


def level(dtype: torch.dtype = torch.float32, height_m: float = HEIGHT) -> Ground:
    return Ground(torch.tensor(0.3, dtype=dtype), height_m=height_m)


@pytest.mark.parametrize("grazing", [17.0, 45.0])
@pytest.mark.parametrize("height", [0.0, -0.4])
def test_a_wall_returns_what_the_closed_form_says_at_its_foot(grazing: float, height: float) -> None:
    high, view = 1.5, View(0.0, grazing)
    black = wall(height + high, height)
    ground, reflectivity = level(height_m=height), torch.tensor(0.5)
    rays = RayGrid((0.02, 0.02))
    bounce = GroundBounce(ground, reflectivity, torch.full((1, len(black)), 0.7))
    grid = ImageGrid(60, 60, (0.15, 0.15), (0.4, 0.4))
    rendering = render(black, [view], grid, rays=rays, ground=ground, echoes=[bounce])
    image = rendering.echoes[1][0]
    pixel = grid.spacing_m[0] * grid.spacing_m[1]
    expected = 4 * 0.5 * 0.7 * 6 * high * math.cos(math.radians(grazing))
    assert float(image.sum()) * pixel == pytest.approx(expected, rel=0.05)  # Gaussians stand out over edges
    foot = -height * math.sin(math.radians(grazing))
    by_row = image.sum(1) / image.sum()
    ranges = torch.from_numpy(grid.range_m).float()
    middle = float((by_row * ranges).sum())
    assert middle == pytest.approx(foot, abs=0.01)
    deviation = math.sqrt(float((by_row * (ranges - middle) ** 2).sum()))
    assert deviation == pytest.approx(math.sqrt(grid.response_variance_m2[1]), rel=0.05)  # a line


def test_real_ones_hide_and_are_not_hidden_by_their_images() -> None:
    """Without their order, images of low ones would stand before high ones that are farther away."""
    scene, ground = cloud(60, 41, kappa=(4.0, 12.0)), level()
    rendering, rays = render(scene, VIEWS, GRID, ground=ground), RayGrid.for_image(GRID)
    direct, below = lit_both_ways(Steps(passes_for("auto", scene.tensors(), GRID)), scene, VIEWS, GRID, rays, HEIGHT)
    torch.testing.assert_close(direct, rendering.lit_area, rtol=1e-5, atol=1e-7)
    assert float(below.sum()) < 0.9 * float(rendering.lit_area.sum())


@pytest.mark.parametrize("scales", [(1.0, 1e-3, 1e-3), (0.5, 0.4, 1e-3), (0.3, 0.2, 0.1)])
@pytest.mark.parametrize("view", [View(40.0, 30.0), View(-70.0, 55.0, tilt_deg=12.0, side="left")])
def test_feet_of_engines_are_those_of_the_reference(view: View, scales: tuple[float, float, float]) -> None:
    scene, shift = with_scales(cloud(20, 3), scales), torch.tensor([[0.3, -0.2]])
    found = []
    for new_pass in (None, passes_for("auto", scene.tensors(), GRID)):
        leaves = [t.detach().clone().requires_grad_() for t in (scene.means, scene.quaternions, scene.scales, shift)]
        pressed = replace(scene, means=leaves[0], quaternions=leaves[1], scales=leaves[2])
        flat = Steps(new_pass).pressed_flat(pressed, [view], GRID, leaves[3], HEIGHT)
        weights = torch.linspace(0.5, 2.0, flat.roots.numel()).view_as(flat.roots)
        ((flat.roots * weights).sum() + (flat.centers * weights[..., :2]).sum()).backward()
        found.append([flat.centers, flat.roots, *(leaf.grad for leaf in leaves)])
    for expected, given in zip(*found, strict=True):
        torch.testing.assert_close(given, expected, rtol=1e-4, atol=1e-4 * float(expected.detach().abs().max()))


def test_feet_are_pressed_flat() -> None:
    scene = cloud(5, 3)
    feet = partial(pressed_flat_reference, views=VIEWS, grid=GRID, shift=None, height_m=HEIGHT)
    flat = feet(scene)
    moved = replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 0.3]))
    torch.testing.assert_close(flat.centers, feet(moved).centers)
    upright = with_scales(scene, (0.3, 0.001, 0.001))
    upright = replace(upright, quaternions=torch.tensor([[math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]]).repeat(5, 1))
    of_response = torch.tensor(GRID.response_variance_m2).rsqrt()  # a vertical needle is a point
    roots = feet(upright).roots
    torch.testing.assert_close(roots[..., [0, 2]], of_response.expand(3, 5, 2), rtol=1e-4, atol=0)


# ---- gradients -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("given", [False, True])
@without_cuts()
def test_gradients_of_the_reference_are_finite_differences(given: bool) -> None:
    scene = few_pixels(FEW(4, 3, degree=2), gain=None)
    leaves = scene.leaves(torch.float64) | {"reflectivity": torch.tensor(0.6, dtype=torch.float64, requires_grad=True)}
    if given:
        leaves["own"] = (0.5 + random_normal(2, 2, 4).abs()).double().requires_grad_()
        del leaves["scattering"]

    def image(*values: Tensor) -> list[Tensor]:
        named = dict(zip(leaves, values, strict=True))
        bounce = GroundBounce(level(torch.float64), named["reflectivity"], named.get("own"))
        return [scene.call(render_reference, named, echoes=[bounce]).echoes[0]]

    check_gradients(image, tuple(leaves.values()))


SCENES = {
    **CLOUDS,
    "dark": lambda: replace(cloud(40, 4), optical_depth=cloud(40, 4).optical_depth * (torch.arange(40) % 3 > 0)),
    "below the ground": lambda: replace(cloud(40, 7), means=cloud(40, 7).means - torch.tensor([0.0, 0.0, 0.3])),
}


def everything(
    scene: Gaussians,
    dtype: torch.dtype,
    renderer: Callable[..., Rendering],
    views: tuple[View, ...] = VIEWS,
    given: bool = False,
) -> dict[str, Tensor]:
    """The echo, and gradients with respect to all tensors."""

    def echo(scene: Gaussians, shift: Tensor, reflectivity: Tensor, own: Tensor | None = None) -> Tensor:
        ground = level(dtype)
        how = {"ground": ground, "echoes": [GroundBounce(ground, reflectivity, own)]}
        return renderer(scene, views, GRID, shift=shift, **how).echoes[1]

    more = {"shift": 0.1 * torch.arange(6.0).view(3, 2), "reflectivity": torch.tensor(0.6)}
    more |= {"own": torch.linspace(0.2, 1.0, 3 * len(scene)).view(3, -1)} if given else {}
    return differentiated(scene, dtype, echo, **more)


@pytest.mark.parametrize(
    ("name", "views", "given"),
    [*((name, VIEWS, False) for name in SCENES), ("opaque", UNUSUAL, False), ("opaque", VIEWS, True)],
)
def test_the_cpu_engine_agrees_with_the_reference(name: str, views: tuple[View, ...], given: bool) -> None:
    scene = SCENES[name]()
    expected = everything(scene, torch.float64, partial(render, engine="reference"), views, given)
    assert ("own" in expected) is given
    for instruction_set in AVAILABLE:
        by = partial(render, engine=f"cpu-{instruction_set}")
        check_agreement(everything(scene, torch.float32, by, views, given), expected)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (2.0, -1.5, 1.2), (30.0, 0.0, 0.0)])
def test_one_call_of_the_engine_is_its_steps(place: tuple[float, float, float]) -> None:
    """Also where rays through the mirror image and those through the scene are few in common, or none."""
    scene = cloud(500, 12, scale=0.06, kappa=(1.0, 6.0))
    scene = replace(scene, means=scene.means * 0.3 + torch.tensor([*place[:2], HEIGHT + 0.5 + place[2]]))
    bounce, rays, grid = GroundBounce(level(), ONE), RayGrid.for_image(GRID), replace(GRID, center_m=place[:2])
    image = render(scene, VIEWS, grid, rays=rays, echoes=[bounce]).echoes[0]
    sections, places = bounce.parts(scene, VIEWS, grid, rays)
    assert relative(image.detach(), splat(places, sections[..., None], grid)[:, 0].double().detach()) <= 1e-5


def test_the_emulated_cuda_engine_agrees_with_the_reference(library: Path) -> None:
    expected = everything(cloud(12, 0), torch.float64, partial(render, engine="reference"))
    check_agreement(everything(cloud(12, 0), torch.float32, partial(render_on, Emulator(library))), expected)


# ---- an echo of one's own is told what a rendering knows, and is added to the images ---------------------------------
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
        ("in_sight", lambda self, means, *_: torch.ones(len(means)), r"in_sight gave torch.float32 \(3,\); it must"),
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
