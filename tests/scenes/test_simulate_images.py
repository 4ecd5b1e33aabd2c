"""Images from either source of truth, and their speckle."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sarsplat.geometry import ImageGrid, View
from sarsplat.scenes import ScatteringLaw, add_speckle, paper_grid
from sarsplat.scenes.meshes import scaled
from sarsplat.scenes.raycast import default_ray_spacing
from sarsplat.scenes.simulate import simulate_images, simulation_record

GRID = ImageGrid(36, 36, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
VIEWS = [View(20.0, 45.0), View(140.0, 30.0)]
BOX = trimesh.creation.box(extents=(6.0, 3.6, 2.0)).apply_translation((0, 0, 1.0))


def test_both_sources_show_the_same_target() -> None:
    counts: list[int] = []
    rays = simulate_images(BOX, VIEWS, GRID, source="raycast", progress=counts.append)
    splats = simulate_images(BOX, VIEWS, GRID, source="splat", progress=counts.append)
    assert counts == [1, 2, 1, 2]
    assert rays.shape == splats.shape == (2, 36, 36)
    assert rays.dtype == splats.dtype == np.float32
    np.testing.assert_allclose(splats.sum(axis=(1, 2)), rays.sum(axis=(1, 2)), rtol=0.02)
    assert np.corrcoef(np.sqrt(rays).ravel(), np.sqrt(splats).ravel())[0, 1] > 0.999


def test_both_sources_stand_on_the_same_ground() -> None:
    rays = simulate_images(BOX, VIEWS, GRID, source="raycast", ground_gamma0=0.2)
    splats = simulate_images(BOX, VIEWS, GRID, source="splat", ground_gamma0=0.2)
    for view, ray, splat in zip(VIEWS, rays, splats, strict=True):
        level = 0.2 * np.tan(np.radians(view.grazing_deg))
        free = np.abs(ray / level - 1) < 1e-3
        assert free.sum() > 100
        assert splat[free].mean() == pytest.approx(level, rel=0.002)
        shadow, dark = ray < 0.05 * level, splat < 0.2 * level
        assert shadow.sum() > 20
        assert dark[shadow].mean() > 0.95
        assert np.corrcoef(np.sqrt(ray).ravel(), np.sqrt(splat).ravel())[0, 1] > 0.99


def test_speckle_depends_on_the_seed_and_may_exclude_images() -> None:
    clean, first, again, other, mixed = (
        simulate_images(BOX, VIEWS, GRID, ground_gamma0=0.5, looks=looks, seed=seed, clean=excluded)
        for looks, seed, excluded in ((None, 1, []), (4, 1, []), (4, 1, []), (4, 2, []), (4, 1, [1]))
    )
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(mixed, [first[0], clean[1]])
    assert (first != other).any()
    ratio = first[clean > 0.01] / clean[clean > 0.01]
    assert ratio.mean() == pytest.approx(1, abs=0.1)
    assert ratio.var() == pytest.approx(0.25, abs=0.08)


def test_a_scene_twenty_times_as_large_has_the_same_images() -> None:
    """β⁰ has no length in it, and pieces and rays follow from the pixels."""
    grid = ImageGrid(36, 36, spacing_m=(6.0, 6.0), resolution_m=(6.0, 6.0))
    for source in ("raycast", "splat"):
        small = simulate_images(BOX, VIEWS, GRID, source=source)  # type: ignore[arg-type]
        large = simulate_images(scaled(BOX, 20.0), VIEWS, grid, source=source)  # type: ignore[arg-type]
        np.testing.assert_allclose(large, small, rtol=1e-3, atol=1e-4 * small.max())


def test_rays_follow_from_the_resolution_but_miss_no_small_target() -> None:
    assert default_ray_spacing(BOX, paper_grid()) == 0.02
    assert default_ray_spacing(scaled(BOX, 0.01), paper_grid()) == pytest.approx(0.0006)
    speck = scaled(BOX, 0.003)  # 18 mm × 11 mm × 6 mm, in cells of 0.3 m
    wide = replace(GRID, resolution_m=(0.6, 0.6))  # at resolution = spacing the pixel lattice would ripple
    image = simulate_images(speck, VIEWS[:1], wide, law=ScatteringLaw(1.0, 0.0))[0]
    area = np.abs(speck.face_normals @ VIEWS[0].direction) @ speck.area_faces / 2  # projected, of a convex body
    assert image.sum() * 0.3**2 == pytest.approx(area, rel=0.02)


@pytest.mark.parametrize("source", ["raycast", "splat"])
def test_the_record_is_json_and_says_the_law(source: str) -> None:
    law = ScatteringLaw(0.2, 0.5)
    record = simulation_record(source=source, law=law, ground_gamma0=None, ray_spacing=0.02, seed=3)  # type: ignore[arg-type]
    assert json.loads(json.dumps(record)) == record
    assert ScatteringLaw(**record["law"]) == law
    assert (record["kind"], record["seed"]) == (source, 3)


# ---- speckle ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("looks", [1, 4, 2.5])
def test_speckle_keeps_the_mean_and_has_variance_one_over_looks(looks):
    power = np.full((400, 400), 3.0, dtype=np.float32)
    speckled = add_speckle(power, looks, np.random.default_rng(0))
    assert speckled.dtype == np.float32 and speckled.shape == power.shape
    assert speckled.mean() == pytest.approx(3.0, rel=0.02)
    assert speckled.var() == pytest.approx(9.0 / looks, rel=0.04)


def test_speckle_is_multiplicative_and_reproducible():
    power = np.array([[0.0, 1.0], [2.0, 5.0]])
    speckled = add_speckle(power, 1, np.random.default_rng(3))
    assert speckled[0, 0] == 0
    np.testing.assert_array_equal(speckled, add_speckle(power, 1, np.random.default_rng(3)))
    np.testing.assert_allclose(add_speckle(10 * power, 1, np.random.default_rng(3)), 10 * speckled)
