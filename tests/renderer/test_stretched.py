"""Unusual views: with a stretched cross-range, a tilted azimuth axis, or a radar that looks to the left."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from compared import check_agreement, check_gradients, differentiated, relative, without_cuts
from emulated_cuda import Emulator
from named_scenes import CLOUDS, FEW, GRID, UNUSUAL, cloud, few_pixels
from torch import Tensor

from sarsplat import Gaussians, Ground, ScatteringLaw, simulate_images, simulate_raycast
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import Rendering, render
from sarsplat.renderer.echoes import GroundEcho
from sarsplat.renderer.engines import cuda
from sarsplat.renderer.operations import Steps
from sarsplat.renderer.stretched import render_stretched

PLAIN = (View(25.0, -40.0, 10.0, aloft=True), View(200.0, 60.0, -70.0, "left", aloft=True))
STRETCHES = (1.07, 0.8)
VIEWS = tuple(replace(view, stretch=stretch) for view, stretch in zip(PLAIN, STRETCHES, strict=True))


def narrower(grid: ImageGrid, stretch: float) -> ImageGrid:
    """The pixels that show the same without a stretch."""
    widths = {
        name: (getattr(grid, name)[0] / stretch, getattr(grid, name)[1]) for name in ("spacing_m", "resolution_m")
    }
    return replace(grid, **widths, center_m=(grid.center_m[0] / stretch, grid.center_m[1]))


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_it_is_the_image_of_narrower_pixels_with_less_power_each(engine: str) -> None:
    scene, rays = cloud(80, 3, kappa=(2.0, 9.0)), RayGrid.for_image(GRID)
    both = render(scene, VIEWS, GRID, rays=rays, engine=engine)
    for image, plain, stretch in zip(both.images, PLAIN, STRETCHES, strict=True):
        expected = render(scene, [plain], narrower(GRID, stretch), rays=rays, engine=engine)
        torch.testing.assert_close(image, expected.images[0] / stretch, rtol=2e-4, atol=2e-5)
    torch.testing.assert_close(both.cross_sections, render(scene, PLAIN, GRID, rays=rays, engine=engine).cross_sections)


@pytest.mark.parametrize("given", [False, True])
@without_cuts()
def test_gradients_are_finite_differences(given: bool) -> None:
    amplitudes = 0.5 + torch.rand(2, 4, 1, generator=torch.Generator().manual_seed(2)) if given else None
    scene = few_pixels(FEW(4, 3, degree=2), views=VIEWS, amplitudes=amplitudes)
    leaves = scene.leaves(torch.float64)

    def uncut(*arguments: Any, first_return_depth: float, **options: Any) -> Rendering:
        return render_stretched(Steps(None), *arguments, **options)

    def outputs(*values: Tensor) -> list[Tensor]:
        rendering = scene.call(uncut, dict(zip(leaves, values, strict=True)))
        return [rendering.images, rendering.cross_sections]

    check_gradients(outputs, tuple(leaves.values()))


def test_without_a_stretch_it_is_what_render_shows() -> None:
    scene, rays = CLOUDS["opaque"](), RayGrid.for_image(GRID)
    expected = render(scene, UNUSUAL, GRID, engine="reference")
    found = render_stretched(Steps(None), scene, UNUSUAL, GRID, rays=rays)
    torch.testing.assert_close(found.images, expected.images, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.cross_sections, expected.cross_sections, rtol=1e-4, atol=1e-6)


def everything(scene: Gaussians, dtype: torch.dtype, renderer: Callable[..., Rendering]) -> dict[str, Tensor]:
    """Image, and gradients with respect to all tensors, shifts and gains."""
    more = {"shift": torch.tensor([[0.1, -0.2], [0.05, 0.1]]), "gain": torch.tensor([0.7, 1.4])}
    return differentiated(scene, dtype, lambda scene, **how: renderer(scene, VIEWS, GRID, **how).images, **more)


@pytest.mark.parametrize("name", CLOUDS)
def test_the_cpu_engine_agrees_with_the_reference(name: str) -> None:
    expected = everything(CLOUDS[name](), torch.float64, partial(render, engine="reference"))
    check_agreement(everything(CLOUDS[name](), torch.float32, partial(render, engine="cpu")), expected)


def test_the_emulated_cuda_engine_agrees_with_the_reference(library: Path) -> None:
    emulated = partial(render_stretched, Steps(partial(cuda.Pass, Emulator(library))), rays=RayGrid.for_image(GRID))
    expected = everything(cloud(12, 0), torch.float64, partial(render, engine="reference"))
    check_agreement(everything(cloud(12, 0), torch.float32, emulated), expected)


def test_plane_gradients_are_those_of_centres() -> None:
    scene = cloud(20, 3)
    means = scene.means.clone().requires_grad_()
    rendering = render(replace(scene, means=means), VIEWS, GRID, plane_gradients=True)
    rendering.images.square().sum().backward()
    assert rendering.plane_gradients is not None
    of_rays, of_pixels = rendering.plane_gradients.double().split(2, dim=-1)
    looks = [view.look for view in VIEWS]
    rays, pixels = (torch.from_numpy(np.stack(axes)) for axes in zip(*((k.frame[:2], k.gradients) for k in looks)))
    assert relative(means.grad, (of_rays @ rays + of_pixels @ pixels).sum(0)) <= 1e-5


# ---- tilted or to the left: symmetry, ground, and ray casting as a witness -------------------------------------------
PLANE = GroundEcho(Ground(torch.tensor(0.2), height_m=-0.3))


def test_left_is_right_mirrored_bit_for_bit():
    right = render(cloud(60, 0), [View(70.0, 40.0, 12.0)], GRID, echoes=[PLANE]).images
    left = render(cloud(60, 0), [View(70.0, 40.0, -12.0, "left")], GRID, echoes=[PLANE]).images
    assert right.amax() > 2 * right.median()
    assert left.flip(-1) == pytest.approx(right, rel=1e-5, abs=1e-6)


def test_a_small_tilt_changes_little():
    level, tilted = (
        render(cloud(60, 0), [View(70.0, 40.0, tilt)], GRID, echoes=[PLANE]).images for tilt in (0.0, 1e-4)
    )
    assert (level - tilted).abs().max() < 1e-4 * level.max()


@pytest.mark.parametrize("view", UNUSUAL, ids=str)
def test_free_ground_is_flat_and_has_its_level(view):
    scene = replace(cloud(1, 0), optical_depth=torch.zeros(1))
    (image,) = render(scene, [view], GRID, echoes=[PLANE]).images
    level = 0.2 * math.tan(math.radians(view.grazing_deg)) / math.cos(math.radians(view.tilt_deg))
    assert image[0].numpy() == pytest.approx(np.full((GRID.rows, GRID.columns), level), rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ground_of_level_views_is_the_same_beside_tilted_ones(dtype):
    scene = replace(cloud(60, 0), means=cloud(60, 0).means + torch.tensor([0.0, 0.0, 1.0])).to(dtype)
    ground = Ground(torch.tensor(0.2, dtype=dtype), height_m=-0.3)
    views = [View(70.0, 40.0), *UNUSUAL]
    together = render(scene, views, GRID, ground=ground).ground
    assert together is not None
    for image, view in zip(together, views, strict=True):
        alone = render(scene, [view], GRID, ground=ground).ground
        assert alone is not None
        torch.testing.assert_close(image, alone[0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("view", UNUSUAL, ids=str)
def test_a_box_on_the_ground_is_imaged_as_by_ray_casting(view):
    """Layover, brightness and shadow lie along the tilted image's own axes."""
    pytest.importorskip("embreex")
    box = trimesh.creation.box((2.0, 1.2, 0.8))
    box.apply_translation([0.2, 0.1, 0.4])
    grid = ImageGrid(40, 40, (0.15, 0.15), (0.25, 0.25))
    how = {"law": ScatteringLaw(), "ground_gamma0": 0.05}
    traced = simulate_raycast(box, view, grid, how["law"], ground_gamma0=0.05)
    splat = simulate_images(box, [view], grid, source="splat", **how)[0]
    assert np.corrcoef(traced.ravel(), splat.ravel())[0, 1] > 0.995
    assert splat.sum() == pytest.approx(traced.sum(), rel=0.03)
    assert (traced < 0.2 * np.median(traced)).any()  # its shadow
