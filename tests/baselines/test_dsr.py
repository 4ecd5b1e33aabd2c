"""DSR learns a shape from masks and images; what it needs and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat.baselines.baseline import Scene
from sarsplat.baselines.mesh_renderer import Layers, MeshRenderer
from sarsplat.baselines.meshes import flatten_loss, icosphere, iou_loss, laplacian_loss
from sarsplat.baselines.method_dsr import Dsr, DsrConfig
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(24, 20, (0.3, 0.35), (0.3, 0.35))
VIEWS = tuple(View(azimuth, 35) for azimuth in (10, 100, 190, 280))
LOW, HIGH = np.array([-0.9, -0.6, 0.0]), np.array([1.3, 0.6, 1.8])
BALL = np.array([0.2, 0, 0.7])
UNIT = 0.05  # the ground's power
BRISK = replace(DsrConfig(), iterations=30, learning_rate=0.03, sigma=1e-4, laplacian=1.0)
"""Few and large steps, for large pixels."""
SHARP = MeshRenderer(GRID, 0.05, 0.05)


def seen(view: View) -> Layers:
    """A ball, smaller than the box."""
    template = icosphere(8)
    points = torch.from_numpy(template.vertices * 0.7 + BALL)
    return SHARP.layers(points, torch.from_numpy(template.faces), torch.full((1280,), 0.4, dtype=torch.float64), view)


@pytest.fixture(scope="module")
def scene_and_images() -> tuple[Scene, torch.Tensor]:
    every = [seen(view) for view in VIEWS]
    masks = [np.where(one.lit > 0.5, 1, np.where(one.hidden > 0.5, 2, 0)) for one in every]
    images = torch.stack([one.target / UNIT + 1 - one.hidden for one in every]).float()
    scene = Scene(VIEWS, GRID, LOW, HIGH, UNIT, np.stack(masks).astype(np.uint8), float(images.max()), ground=True)
    return scene, images


def mask_iou(model: Dsr) -> float:
    assert model.scene.masks is not None
    with torch.no_grad():
        lit = np.stack([(model.layers(view).lit > 0.5).numpy() for view in model.scene.views])
    true = model.scene.masks == 1
    return float((lit & true).sum() / (lit | true).sum())


def off_the_ball(vertices: np.ndarray) -> float:
    """Mean distance from the surface of the ball that the images show, m."""
    return float(np.abs(np.linalg.norm(vertices - BALL, axis=1) - 0.7).mean())


def trained(scene: Scene, images: torch.Tensor, steps: int) -> tuple[Dsr, list[float]]:
    model = Dsr(scene, BRISK)
    optimiser, generator, losses = model.optimiser(), torch.Generator(), []
    rates = [group["lr"] for group in optimiser.param_groups]
    for step in range(steps):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * model.rate(step)
        optimiser.zero_grad()
        loss = model.loss(torch.arange(len(images)), images, generator)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    return model, losses


@pytest.mark.slow
def test_it_learns_a_ball_from_an_ellipsoid(scene_and_images):
    scene, images = scene_and_images
    assert mask_iou(Dsr(scene, BRISK)) < 0.6
    model, losses = trained(scene, images, 30)
    assert losses[-1] < 0.6 * losses[0]
    assert mask_iou(model) > 0.85
    vertices, faces = model.surface()
    assert (vertices.dtype, faces.dtype, vertices.shape, faces.shape) == (np.float64, np.int64, (642, 3), (1280, 3))
    assert off_the_ball(vertices) < 0.65 * off_the_ball(Dsr(scene, BRISK).surface()[0])
    assert (vertices[:, 2] >= 0).all()  # nothing below the ground
    image = model.image(VIEWS[0])
    assert image.shape == (24, 20)
    assert (image > 0).all()


def test_the_number_of_threads_changes_no_bit(scene_and_images, threads):
    results = []
    for count in (1, 3):
        threads(count)
        model, losses = trained(*scene_and_images, steps=2)
        results.append((losses, model.moved.detach().clone()))
    assert results[0][0] == results[1][0]
    assert torch.equal(results[0][1], results[1][1])


def test_iou_loss_of_masks():
    first = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    second = torch.tensor([[0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    assert iou_loss(first, second).item() == pytest.approx(2 / 3, abs=1e-5)
    assert iou_loss(first, first).item() == pytest.approx(0)
    assert iou_loss(0 * first, 0 * first).item() == pytest.approx(0)


def test_regularity_against_closed_forms_and_finite_differences():
    template = icosphere(1)
    points, faces, edges, flaps = (
        torch.from_numpy(one) for one in (template.vertices, template.faces, template.edges, template.flaps)
    )
    # a vertex of the icosahedron stands 1 − 1/√5 above its neighbours' mean; its faces meet at arccos(−√5/3)
    assert laplacian_loss(points, edges).item() == pytest.approx(12 * (1 - 5**-0.5) ** 2)
    assert flatten_loss(points, faces, flaps).item() == pytest.approx(30 * (1 - 5**0.5 / 3) ** 2)
    moved = (
        points + 0.1 * torch.rand(points.shape, generator=torch.Generator().manual_seed(0)).double()
    ).requires_grad_()
    assert torch.autograd.gradcheck(lambda one: laplacian_loss(one, edges), moved)
    assert torch.autograd.gradcheck(lambda one: flatten_loss(one, faces, flaps), moved)


def test_images_without_ground_are_dark_around_the_target(scene_and_images):
    scene, _ = scene_and_images
    model = Dsr(replace(scene, ground=False), DsrConfig(vertices=1352))
    assert len(model.surface()[0]) == 1352
    assert not model.image(VIEWS[0])[0].any()  # nothing but the target's own return
    assert [name for name, _ in model.named_parameters()] == ["moved", "log_gamma0"]
