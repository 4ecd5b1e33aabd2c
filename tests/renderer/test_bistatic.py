"""Transmitter and receiver apart: closed forms, gradients, engines against the reference, and ray casting."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from emulated_cuda import Emulator
from named_scenes import GRID, UNUSUAL, VIEWS, cloud, with_scales
from test_cpu_engine import relative
from test_reference_gradients import check_gradients
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Stack, View
from sarsplat.radar.iso_range import Pixel, contributions
from sarsplat.renderer import GroundBounce, Rendering, project, render, render_covariances
from sarsplat.renderer.bistatic import render_by_steps
from sarsplat.renderer.echoes import GroundEcho
from sarsplat.renderer.engines import cuda
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.one_by_one import Steps
from sarsplat.scenes import ScatteringLaw, simulate_raycast
from sarsplat.scenes.raycast import raycast_mask
from sarsplat.scenes.simulate import simulate_images
from sarsplat.surface.points import extract_points
from sarsplat.tiles import render_tiled
from terrains import slope

pytestmark = pytest.mark.filterwarnings("ignore:.* of the target's surface is below the ground")


def apart(first: tuple[float, float], second: tuple[float, float], **how: object) -> View:
    return View.bistatic(View(*first).direction, View(*second).direction, **how)  # type: ignore[arg-type]


APART = (
    apart((20.0, 40.0), (50.0, 40.0)),
    apart((200.0, 30.0), (290.0, 65.0), tilt_deg=15.0, side="left"),
    apart((77.0, 70.0), (20.0, 15.0)),
)


def by_the_book(gaussians: Gaussians, views: tuple[View, ...], grid: ImageGrid, **how: object) -> Rendering:
    return render_by_steps(Steps(None, cuts=False), gaussians, views, grid, **how)  # type: ignore[arg-type]


# ---- closed forms ----------------------------------------------------------------------------------------------------
def test_equal_ways_are_one_radar_bit_for_bit() -> None:
    scene, direction = cloud(60, 0), VIEWS[0].direction
    same, one = View.bistatic(direction, direction), View.towards(direction)
    assert same == one
    assert torch.equal(render(scene, [same], GRID).images, render(scene, [one], GRID).images)
    tilted = View.bistatic(direction, direction, tilt_deg=10.0, side="left")
    assert tilted == replace(one, tilt_deg=10.0, side="left")


@pytest.mark.parametrize("views", [VIEWS, UNUSUAL])
def test_step_by_step_one_radar_sees_what_render_shows(views: tuple[View, ...]) -> None:
    scene, rays = cloud(60, 41, kappa=(4.0, 12.0)), RayGrid.for_image(GRID)
    expected = render(scene, views, GRID, engine="reference")
    found = render_by_steps(Steps(None, cuts=True), scene, views, GRID, rays=rays)
    torch.testing.assert_close(found.images, expected.images, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.cross_sections, expected.cross_sections, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("view", APART, ids=str)
def test_a_point_lies_where_summed_ways_say_and_is_as_wide_as_the_response(view: View) -> None:
    place, (u_t, u_r) = np.array([0.23, -0.31, 0.4]), view.look.ways
    point = with_scales(replace(cloud(1, 0), means=torch.from_numpy(place[None]).float()), (0.02, 0.02, 0.02))
    point = replace(point, optical_depth=torch.tensor([5.0]))
    grid = ImageGrid(80, 80, (0.05, 0.05), (0.3, 0.3))
    image = render(point, [view], grid).images[0, 0].double().numpy()
    across, away = (image.sum(axis) / image.sum() for axis in (0, 1))
    assert away @ grid.range_m == pytest.approx(-0.5 * (u_t + u_r) @ place, abs=1e-4)
    assert across @ grid.azimuth_m == pytest.approx(view.look.frame[0] @ place, abs=1e-4)
    widths = (
        across @ grid.azimuth_m**2 - (across @ grid.azimuth_m) ** 2,
        away @ grid.range_m**2 - (away @ grid.range_m) ** 2,
    )
    shortened = np.array([1.0, math.cos(math.radians(view.apart_deg / 2))])
    assert widths == pytest.approx(grid.response_variance_m2 + (0.02 * shortened) ** 2, rel=0.01)
    assert view.look.frame[0] @ (u_t + u_r) == pytest.approx(0.0, abs=1e-12)


def test_resolution_along_the_ground_is_coarser_by_the_shortened_gradient() -> None:
    """What is 1 m long away from the radar takes cos β/2 metres of slant range, at the resolution of one radar."""
    view = apart((-30.0, 20.0), (30.0, 20.0))
    half = math.radians(view.apart_deg / 2)
    away = -view.direction
    needle = replace(with_scales(cloud(1, 0), (0.5, 0.02, 0.02)), means=torch.zeros(1, 3))
    needle = replace(needle, optical_depth=torch.tensor([5.0]))
    turn = np.cross([1.0, 0.0, 0.0], away)
    angle = math.acos(away[0])
    axis = turn / np.linalg.norm(turn) * math.sin(angle / 2)
    needle = replace(needle, quaternions=torch.tensor([[math.cos(angle / 2), *axis]], dtype=torch.float32))
    grid = ImageGrid(80, 40, (0.1, 0.1), (0.3, 0.3))
    by_row = render(needle, [view], grid).images[0, 0].double().sum(1).numpy()
    by_row /= by_row.sum()
    variance = by_row @ grid.range_m**2 - (by_row @ grid.range_m) ** 2
    expected = (0.5 * math.cos(half)) ** 2 + grid.response_variance_m2[1]
    assert variance == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("azimuth", "separation"), [(20.0, 30.0), (140.0, 60.0), (300.0, 90.0)])
def test_a_box_is_lit_both_ways_as_by_ray_casting(azimuth: float, separation: float) -> None:
    pytest.importorskip("embreex")
    box = trimesh.creation.box((2.0, 1.2, 0.8))
    tower = trimesh.creation.box((0.6, 0.6, 1.0))
    tower.apply_translation([0.3, 0.1, 0.9])
    scene = trimesh.util.concatenate(box, tower)
    grid, law = ImageGrid(48, 48, (0.1, 0.1), (0.2, 0.2)), ScatteringLaw(0.1, 0.9, 8.0)
    view = apart((azimuth, 35.0), (azimuth + separation, 35.0))
    traced = simulate_raycast(scene, view, grid, law)
    splat = simulate_images(scene, [view], grid, source="splat", law=law)[0]
    assert splat.sum() == pytest.approx(traced.sum(), rel=0.025)
    assert np.corrcoef(traced.ravel(), splat.ravel())[0, 1] > 0.999


def test_ray_casting_of_a_plate_has_its_closed_form_and_nearly_equal_ways_are_one_radar() -> None:
    pytest.importorskip("embreex")
    grid, law = ImageGrid(48, 48, (0.1, 0.1), (0.2, 0.2)), ScatteringLaw(0.1, 0.9, 2.0)
    plate = trimesh.Trimesh([[-0.7, -0.5, 0], [0.7, -0.5, 0], [0.7, 0.5, 0], [-0.7, 0.5, 0]], [[0, 1, 2], [0, 2, 3]])
    view = apart((20.0, 40.0), (80.0, 25.0))
    (u_t, u_r), h = view.look.ways, view.direction
    expected = (0.1 + 0.9 * h[2] ** 2) * 1.4 * math.sqrt(u_t[2] * u_r[2])
    traced = simulate_raycast(plate, view, grid, law)
    assert traced.sum() * 0.1 * 0.1 == pytest.approx(expected, rel=2e-3)
    upright = plate.copy()
    upright.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0)))
    between = apart((-80.0, 30.0), (60.0, 30.0))  # one on each side
    assert simulate_raycast(upright, between, grid, law).sum() == 0
    assert simulate_images(upright, [between], grid, source="splat", law=law)[0].sum() == pytest.approx(0, abs=1e-6)
    box = trimesh.creation.box((2.0, 1.2, 0.8))
    one, near = (simulate_raycast(box, v, grid, law) for v in (View(30.0, 20.0), apart((30.0, 20.0), (30.001, 20.0))))
    assert near == pytest.approx(one, abs=5e-3 * float(one.max()))


def test_the_transmitter_shades_what_the_receiver_sees() -> None:
    pytest.importorskip("embreex")
    floor = trimesh.creation.box((2.0, 2.0, 0.02))
    wall = trimesh.creation.box((0.02, 2.0, 1.0))
    wall.apply_translation([0.5, 0.0, 0.5])
    grid, law = ImageGrid(48, 48, (0.1, 0.1), (0.2, 0.2)), ScatteringLaw(0.0, 1.0, 0.0)
    over = apart((0.0, 30.0), (180.0, 80.0))  # from behind the wall, and from above
    reverse = apart((180.0, 80.0), (0.0, 30.0))
    both = trimesh.util.concatenate(floor, wall)
    traced = simulate_raycast(both, over, grid, law)
    assert traced.sum() < 0.6 * simulate_raycast(floor, over, grid, law).sum()
    assert simulate_raycast(both, reverse, grid, law).sum() == pytest.approx(traced.sum(), rel=0.01)  # reciprocity


# ---- level ground ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("view", APART, ids=str)
def test_open_ground_has_the_area_that_both_ways_light(view: View) -> None:
    """γ⁰ √((n·u_t)(n·u_r)) over as much ground as a pixel shows: that is where its corners are, half both ways away."""
    u_t, u_r = view.look.ways
    gradients = np.stack([view.look.frame[0], -(u_t + u_r) / 2])[:, :2]
    expected = 0.2 * math.sqrt(u_t[2] * u_r[2]) / abs(np.linalg.det(gradients))
    away = replace(cloud(3, 0), means=cloud(3, 0).means + torch.tensor([300.0, 0.0, 5.0]))
    for engine, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        ground = Ground(torch.tensor(0.2, dtype=dtype))
        for scene in (away.to(dtype), away.to(dtype)[:0]):
            image = render(scene, [view], GRID, ground=ground, engine=engine).images
            torch.testing.assert_close(image, torch.full_like(image, expected))


def test_ground_of_equal_ways_is_one_radars() -> None:
    """Step by step, whatever is before it, how it is shifted, its places and its law."""
    scene = cloud(60, 41, kappa=(0.5, 12.0))
    scene = replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 1.0]))
    table = torch.rand(5, 6, generator=torch.Generator().manual_seed(3))
    ground = Ground(table, 0.7, -0.2, torch.tensor(0.8))
    shift, rays = torch.tensor([[0.2, -0.1]] * len(UNUSUAL)), RayGrid.for_image(GRID)
    expected = render(scene, UNUSUAL, GRID, ground=ground, shift=shift)
    found = render_by_steps(
        Steps(passes_for("cpu", scene.tensors(), GRID), cuts=True),
        scene,
        UNUSUAL,
        GRID,
        rays=rays,
        shift=shift,
        ground=GroundEcho(ground),
    )
    assert expected.ground is not None
    assert float(expected.ground.min()) < 0.5 * float(expected.ground.max())
    torch.testing.assert_close(found.echoes[0], expected.ground, rtol=2e-3, atol=1e-5)
    mixed = render(scene, [UNUSUAL[0], APART[0]], GRID, ground=ground, shift=shift[:2])
    assert mixed.ground is not None
    torch.testing.assert_close(mixed.ground[0], expected.ground[0], rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize(
    "view",
    [
        apart((20.0, 35.0), (55.0, 35.0)),
        apart((0.0, 12.0), (40.0, 25.0)),
        apart((20.0, 35.0), (55.0, 30.0), tilt_deg=-10.0, side="left"),
        apart((0.0, 40.0), (150.0, 50.0)),
    ],
    ids=str,
)
def test_the_ground_is_in_shadow_of_either_way_as_by_ray_casting(view: View) -> None:
    pytest.importorskip("embreex")
    box = trimesh.creation.box((2.0, 1.2, 0.8))
    box.apply_translation((0.2, 0.1, 0.4))
    grid, how = ImageGrid(64, 64, (0.15, 0.15), (0.25, 0.3)), {"law": ScatteringLaw(0.3, 0.7, 2.0)}
    casting = partial(simulate_raycast, grid=grid, **how, ray_spacing=0.02)
    splatting = partial(simulate_images, views=[view], grid=grid, source="splat", **how)
    on_ground = casting(box, view, ground_gamma0=0.2), splatting(box, ground_gamma0=0.2)[0]
    assert on_ground[0][0, 0] == pytest.approx(on_ground[1][0, 0], rel=1e-5)
    assert np.corrcoef(*(image.ravel() for image in on_ground))[0, 1] > 0.9995
    alone = casting(box, view), splatting(box)[0]
    ground = [image - target for image, target in zip(on_ground, alone, strict=True)]
    lacking = [(image - image[0, 0]).sum() for image in ground]
    assert lacking[0] == pytest.approx(lacking[1], rel=0.03)
    legs = [casting(box, leg, ground_gamma0=0.2) - casting(box, leg) for leg in view.legs]
    dark = [  # m² of ground; either way darkens some that the other does not
        (1 - image / image[0, 0]).sum() * abs(np.linalg.det(one.look.onto_ground))
        for image, one in zip((ground[0], *legs), (view, *view.legs), strict=True)
    ]
    assert max(dark[1:]) < dark[0] < 1.02 * sum(dark[1:])
    if view.apart_deg < 60:
        deeper = trimesh.creation.box((2.0, 1.2, 2.0))
        deeper.apply_translation((0.2, 0.1, -0.2))
        np.testing.assert_allclose(
            casting(deeper, view, ground_gamma0=0.2), on_ground[0], atol=0.01 * on_ground[0].max()
        )


# ---- gradients, engines ----------------------------------------------------------------------------------------------
def _leaves(scene: Gaussians, views: int, dtype: torch.dtype) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    leaves = {name: tensor.to(dtype, copy=True) for name, tensor in scene.tensors().items()}
    leaves["shift"] = (0.1 * torch.randn(views, 2, generator=generator, dtype=torch.float64)).to(dtype)
    leaves["gain"] = (0.5 + torch.rand(views, generator=generator, dtype=torch.float64)).to(dtype)
    return {name: tensor.requires_grad_() for name, tensor in leaves.items()}


def test_gradients_of_ground_are_finite_differences() -> None:
    scene = cloud(3, 3, size=(0.6, 0.5, 0.3), scale=0.2, kappa=(0.7, 2.0))
    scene = replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 0.5])).to(torch.float64)
    grid, rays = ImageGrid(5, 6, spacing_m=(0.35, 0.35), resolution_m=(0.4, 0.45)), RayGrid((0.27, 0.31))
    names = ("means", "scales", "optical_depth")
    leaves = [getattr(scene, name).clone().requires_grad_() for name in names]
    table = (0.5 + torch.rand(3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)).requires_grad_()
    exponent = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    shift = torch.tensor([[0.03, -0.05], [0.02, 0.1]], dtype=torch.float64, requires_grad=True)

    def outputs(*values: Tensor) -> list[Tensor]:
        *tensors, places, power, moved = values
        echo = GroundEcho(Ground(places, 0.4, -0.1, power))
        there = scene.with_tensors(**dict(zip(names, tensors, strict=True)))
        return [by_the_book(there, APART[:2], grid, rays=rays, shift=moved, ground=echo).echoes[0]]

    check_gradients(outputs, (*leaves, table, exponent, shift))


@pytest.mark.parametrize("given", [False, True])
def test_gradients_of_the_reference_are_finite_differences(given: bool) -> None:
    scene = cloud(4, 3, size=(0.6, 0.5, 0.5), scale=0.2, kappa=(0.7, 2.0), degree=2)
    grid, rays = ImageGrid(5, 6, spacing_m=(0.35, 0.35), resolution_m=(0.4, 0.45)), RayGrid((0.27, 0.31))
    leaves = _leaves(scene, 2, torch.float64)
    if given:
        own = 0.5 + torch.rand(2, 4, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        leaves["amplitudes"] = own.requires_grad_()
        del leaves["scattering"]

    def outputs(*values: Tensor) -> list[Tensor]:
        named = dict(zip(leaves, values, strict=True))
        fields = {name: named.get(name, tensor.double()) for name, tensor in scene.tensors().items()}
        how = {name: named.get(name) for name in ("shift", "gain", "amplitudes")}
        rendering = by_the_book(scene.with_tensors(**fields), APART[:2], grid, rays=rays, **how)
        return [rendering.images, rendering.cross_sections]

    check_gradients(outputs, tuple(leaves.values()))
    image = outputs(*leaves.values())[0]
    weights = torch.linspace(1, 2, image.numel(), dtype=image.dtype).view_as(image)
    for name, gradient in zip(leaves, torch.autograd.grad((image * weights).sum(), list(leaves.values())), strict=True):
        assert (gradient.reshape(gradient.shape[0], -1).norm(dim=1) > 1e-6).all(), name


SCENES = {
    "overlap": lambda: cloud(60, 0),
    "opaque": lambda: cloud(60, 41, kappa=(4.0, 12.0)),
    "needles": lambda: with_scales(cloud(40, 5), (0.5, 0.01, 0.01)),
    "discs": lambda: with_scales(cloud(40, 6), (0.2, 0.2, 0.002)),
}


def _everything(scene: Gaussians, dtype: torch.dtype, renderer: Callable[..., Rendering]) -> dict[str, Tensor]:
    leaves = _leaves(scene, 3, dtype)
    fields = {name: leaves[name] for name in scene.tensors()}
    leaves["gamma0"] = torch.full((3, 3), 0.1, dtype=dtype, requires_grad=True)
    how = {"shift": leaves["shift"], "gain": leaves["gain"], "ground": Ground(leaves["gamma0"], 0.5, -1.0)}
    image = renderer(scene.with_tensors(**fields), APART, GRID, **how).images
    cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    found = torch.autograd.grad((image * cotangent.to(dtype)).sum(), list(leaves.values()))
    return {"image": image.detach(), **dict(zip(leaves, found, strict=True))}


@pytest.mark.parametrize("name", SCENES)
def test_the_cpu_engine_agrees_with_the_reference(name: str) -> None:
    scene = SCENES[name]()
    expected = _everything(scene, torch.float64, partial(render, engine="reference"))
    found = _everything(scene, torch.float32, partial(render, engine="cpu"))
    assert relative(found["image"], expected["image"]) <= 1e-5
    for argument, value in expected.items():
        assert float(value.norm()) > 0, argument
        assert relative(found[argument], value) <= 1e-4, argument


def test_the_emulated_cuda_engine_agrees_with_the_reference(library: Path) -> None:
    def emulated(gaussians: Gaussians, views: tuple[View, ...], grid: ImageGrid, ground: Ground, **how: Tensor):  # type: ignore[no-untyped-def]
        steps = Steps(partial(cuda.Pass, Emulator(library)), cuts=True)
        return render_by_steps(
            steps, gaussians, views, grid, rays=RayGrid.for_image(grid), ground=GroundEcho(ground), **how
        )

    scene = cloud(12, 0)
    expected = _everything(scene, torch.float64, partial(render, engine="reference"))
    found = _everything(scene, torch.float32, emulated)
    for argument, value in expected.items():
        assert relative(found[argument], value) <= 1e-4, argument


def test_the_same_bits_for_any_number_of_threads() -> None:
    scene, threads = cloud(3000, 8, scale=0.05), torch.get_num_threads()
    found = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(_everything(scene, torch.float32, render))
    finally:
        torch.set_num_threads(threads)
    for name, value in found[0].items():
        assert torch.equal(value, found[1][name]), name


def test_plane_gradients_are_those_of_centres() -> None:
    scene = cloud(20, 3)
    means = scene.means.clone().requires_grad_()
    rendering = render(replace(scene, means=means), APART, GRID, plane_gradients=True)
    rendering.images.square().sum().backward()
    planes = rendering.plane_gradients
    assert planes is not None
    assert planes.shape == (3, 20, 4)
    assert (planes.abs().sum((0, 1)) > 0).all()


def test_what_makes_a_pixel_adds_up_to_it() -> None:
    scene, view = cloud(60, 41, kappa=(4.0, 12.0)), APART[0]
    image = render(scene, [view], GRID).images[0, 0]
    assert contributions(scene, view, GRID, Pixel(9, 12)).sum() == pytest.approx(float(image[9, 12]), rel=1e-4)


def test_points_lie_on_what_either_way_sees() -> None:
    from sarsplat.settings.sections import PointExtraction

    scene = cloud(60, 41, kappa=(4.0, 12.0))
    how = PointExtraction(cluster_radius=None)
    both = extract_points(scene, APART, GRID, how)
    legs = extract_points(scene, [leg for view in APART for leg in view.legs], GRID, how)
    assert len(both)
    np.testing.assert_array_equal(both, legs)


# ---- what does not fit -----------------------------------------------------------------------------------------------
def test_what_bistatic_images_cannot_have_is_refused() -> None:
    scene, view = cloud(3, 0), APART[0]
    ground = Ground(torch.tensor(0.2))
    bounce, hill = GroundBounce(ground, torch.tensor(0.5)), slope(0.1)
    mesh, law = trimesh.creation.box((1.0, 1.0, 1.0)), ScatteringLaw()
    calls: list[tuple[str, Callable[[], object]]] = [
        (
            "no echoes but level ground, neither terrain",
            lambda: render(scene, [view], GRID, ground=replace(ground, height_m=hill)),
        ),
        ("no echoes but level ground, neither terrain", lambda: render(scene, [VIEWS[0], view], GRID, echoes=[bounce])),
        ("no echoes but level ground", lambda: render(scene, [view], GRID, ground=ground, echoes=[GroundEcho(ground)])),
        ("have no ray maps", lambda: render(scene, [view], GRID, first_return_depth=1.0)),
        ("view.legs, or use render", lambda: project(scene, [view], GRID)),
        ("view.legs, or use render", lambda: render_covariances(scene, [view], GRID, Stack(0.03, (0.0, 0.001)))),
        ("by tiles only if one radar", lambda: render_tiled(scene, view, GRID)),
        ("the bounce off the ground", lambda: bounce.parts(scene, [view], GRID, RayGrid.for_image(GRID))),
        (
            "neither terrain nor second",
            lambda: simulate_raycast(mesh, view, GRID, law, ground_gamma0=0.1, terrain=hill),
        ),
        ("neither terrain nor second", lambda: simulate_raycast(mesh, view, GRID, law, bounces=2)),
        ("masks are of what one radar", lambda: raycast_mask(mesh, view, GRID)),
    ]
    for said, call in calls:
        with pytest.raises(SarsplatError, match=said):
            call()


def test_views_that_cannot_be_are_refused() -> None:
    for said, call in (
        ("more than 170°", lambda: apart((0.0, 2.0), (180.0, 2.0))),
        ("below the horizon", lambda: View(0.0, 5.0, apart_deg=40.0, apart_towards_deg=90.0)),
        ("no direction", lambda: View.bistatic((0, 0, 0), (0, 0, 1))),
        ("not between 0° and 170°", lambda: View(0.0, 5.0, apart_deg=-1.0)),
        ("is not apart", lambda: View(0.0, 5.0, apart_towards_deg=3.0)),
    ):
        with pytest.raises(SarsplatError, match=said):
            call()
