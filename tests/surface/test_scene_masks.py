"""Masks of a scene against those of the mesh that it was made of, by ray casting."""

from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest
import torch

from made import overlap, upright
from sarsplat.gaussians import Gaussians, Ground
from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, RayGrid, View
from sarsplat.learning.method_sar_gs import GaussianReconstruction
from sarsplat.scenes.raycast import raycast_mask
from sarsplat.surface.masks import scene_masks

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

GRID = ImageGrid(48, 40, (0.3, 0.3), (0.5, 0.5))
RAYS = RayGrid.for_image(GRID, 4)
VIEWS = [View(20, 30), View(250, 45)]


def box(height: float = 1.5) -> trimesh.Trimesh:
    return trimesh.creation.box((4, 2, height), trimesh.transformations.translation_matrix((0.5, 0, height / 2)))


GROUND = Ground(torch.tensor(0.7))


def scene(mesh: trimesh.Trimesh) -> Gaussians:
    """As bright as the ground."""
    from sarsplat.scenes.splat_truth import surface_gaussians

    target, _ = surface_gaussians(mesh, 0.15)
    return target.with_tensors(scattering=torch.zeros(len(target), 1))


@pytest.mark.parametrize("height", [1.5, 3.0])
def test_masks_are_those_of_the_mesh(height: float) -> None:
    masks = scene_masks(scene(box(height)), GROUND, VIEWS, GRID, RAYS)
    assert (masks.dtype, masks.shape) == (np.uint8, (2, 48, 40))
    for mask, view in zip(masks, VIEWS, strict=True):
        true = raycast_mask(box(height), view, GRID)
        assert overlap(mask == TARGET, true == TARGET) > 0.9
        assert overlap(mask == SHADOW, true == SHADOW) > 0.9


@pytest.mark.parametrize("tilt", [0.0, 30.0, -60.0, 80.0, -87.0])
@pytest.mark.parametrize("side", ["right", "left"])
def test_what_stands_on_tilted_ground_is_seen(tilt: float, side: Literal["right", "left"]) -> None:
    """Though pixels show more ground, until it is edge-on; so it is with true masks, and without ground."""
    view = View(20, 30, tilt, side)
    true = raycast_mask(box(), view, GRID)
    for ground in (GROUND, None):
        (mask,) = scene_masks(scene(box()), ground, [view], GRID, RAYS)
        assert overlap(mask == TARGET, true == TARGET) > 0.8
        assert (mask == SHADOW).any() == (ground is not None and abs(tilt) < 85)
    level = raycast_mask(box(), VIEWS[0], GRID)
    assert (true == TARGET).sum() > 0.75 * (level == TARGET).sum()


def test_the_ground_decides_what_is_bright() -> None:
    alike = scene(box())
    shares = []
    for step in (-20.0, 0.0, 3.0):  # added before softplus: black, as the ground, brighter
        parameters = alike.scattering.parameters + step / 0.28
        masks = scene_masks(alike.with_tensors(scattering=parameters), GROUND, VIEWS, GRID, RAYS)
        shares.append(int((masks == TARGET).sum()))
        assert (masks == SHADOW).any()
    assert shares[0] == 0
    assert shares[1] < shares[2] < 1.5 * shares[1]


def masks_of(target: Gaussians, ground: Ground | None, points: np.ndarray, views: list[View]) -> np.ndarray:
    model = SimpleNamespace(
        target=lambda degree: target, ground=lambda: ground, degree=lambda iteration: 0, as_displaced=lambda grid: grid
    )
    learned = object.__new__(GaussianReconstruction)
    config, snapshot = SimpleNamespace(preset="default"), SimpleNamespace(iteration=0)
    vars(learned).update(model=model, grid=GRID, config=config, snapshot=snapshot)
    return learned.masks(views, points.astype(np.float32))


def haze(count: int) -> Gaussians:
    """Low Gaussians all around, as opaque as the ground."""
    means = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([12, 12, 0.1])
    return upright(means - torch.tensor([6, 6, 0]), 0.2, 3.0, 0.0)


def test_what_lies_around_the_points_is_not_the_target() -> None:
    target = scene(box())
    points = Gaussians.cat([target, haze(100)]).means.numpy()
    masks = masks_of(Gaussians.cat([target, haze(500)]), GROUND, points, VIEWS)
    for mask, view in zip(masks, VIEWS, strict=True):
        true = raycast_mask(box(), view, GRID)
        assert overlap(mask == TARGET, true == TARGET) > 0.8
        assert overlap(mask == SHADOW, true == SHADOW) > 0.8


@pytest.mark.parametrize("ground", [False, True])
def test_without_points_there_is_no_target(ground: bool) -> None:
    masks = masks_of(scene(box()), GROUND if ground else None, np.empty((0, 3)), VIEWS[:1])
    assert not masks[:, 4:-4, 4:-4].any()


@pytest.mark.parametrize("view", [View(30.0, -40.0, aloft=True), View(30.0, 35.0, 80.0, "left", aloft=True)])
def test_aloft_there_is_target_and_nothing_else(view: View) -> None:
    mesh = box(3.0)
    mesh.apply_translation((0, 0, -1.5))  # around the origin
    (mask,), true = scene_masks(scene(mesh), None, [view], GRID, RAYS), raycast_mask(mesh, view, GRID)
    assert overlap(mask == TARGET, true == TARGET) > 0.9
    assert set(np.unique(mask)) == set(np.unique(true)) == {CLUTTER, TARGET}
