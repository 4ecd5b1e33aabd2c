"""DSR learns a shape; its losses, closed meshes and soft coverage of pixels against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from made import overlap
from made_runs import baseline_losses
from sarsplat.baselines import Scene, soft_raster
from sarsplat.baselines.mesh_renderer import Layers, MeshRenderer
from sarsplat.baselines.meshes import cube_sphere, flatten_loss, icosphere, iou_loss, laplacian_loss
from sarsplat.baselines.method_dsr import Dsr, DsrConfig
from sarsplat.baselines.soft_raster import Lattice, soft_coverage
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(24, 20, (0.3, 0.35), (0.3, 0.35))
VIEWS = tuple(View(azimuth, 35) for azimuth in (10, 100, 190, 280))
LOW, HIGH = np.array([-0.9, -0.6, 0.0]), np.array([1.3, 0.6, 1.8])
BALL = np.array([0.2, 0, 0.7])
UNIT = 0.05  # the ground's power
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


@pytest.mark.slow
def test_it_learns_a_ball_from_an_ellipsoid(scene_and_images):
    scene, images = scene_and_images
    model = Dsr(scene, DsrConfig(iterations=30, learning_rate=0.03, sigma=1e-4, laplacian=1.0))

    def shared() -> float:
        lit = torch.stack([model.layers(view).lit for view in VIEWS]) > 0.5
        return overlap(lit.numpy(), scene.masks == 1)

    def off_m() -> float:
        return float(np.abs(np.linalg.norm(model.surface()[0] - BALL, axis=1) - 0.7).mean())

    before, off_before = shared(), off_m()
    losses = baseline_losses(model, images, 30)
    assert losses[-1] < 0.6 * losses[0]
    assert before < 0.6 and shared() > 0.85
    assert off_m() < 0.65 * off_before
    vertices, faces = model.surface()
    assert (vertices.dtype, faces.dtype, vertices.shape, faces.shape) == (np.float64, np.int64, (642, 3), (1280, 3))
    assert (vertices[:, 2] >= 0).all()  # nothing below the ground


def test_the_number_of_threads_changes_no_bit(scene_and_images, threads):
    scene, images = scene_and_images
    results = []
    for count in (1, 2):
        threads(count)
        model = Dsr(scene, DsrConfig(sigma=1e-4, views_per_step=1))  # soft edges, for large pixels
        results.append((baseline_losses(model, images, 2), model.moved.detach().clone()))
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
    assert (Dsr(scene, DsrConfig()).image(VIEWS[0]) > 0).all()
    model = Dsr(replace(scene, ground=False), DsrConfig(vertices=1352))
    assert len(model.surface()[0]) == 1352
    assert not model.image(VIEWS[0])[0].any()  # nothing but the target's own return
    assert [name for name, _ in model.named_parameters()] == ["moved", "log_gamma0"]


# ---- soft coverage of pixels by triangles; closed template meshes ----------------------------------------------------
LATTICE = Lattice.of(ImageGrid(12, 9, (0.5, 0.25), (1.0, 1.0), (0.3, -0.2)))
TRIANGLES = torch.tensor(
    [[[-1.0, -0.7], [1.1, -0.6], [0.2, 1.0]], [[0.4, 0.1], [0.3, -1.0], [2.0, 0.2]]], dtype=torch.float64
)


def test_coverage_is_the_sigmoid_of_the_squared_distance_to_the_outline():
    got = soft_coverage(TRIANGLES[:1], LATTICE, 0.3).union().reshape(LATTICE.rows, LATTICE.columns).numpy()
    corners = TRIANGLES[0].numpy()
    for row in range(LATTICE.rows):
        for column in range(LATTICE.columns):
            point = np.array([column, row]) * LATTICE.step_m + LATTICE.first_m
            ts = np.linspace(0, 1, 2001)[:, None]
            outline = np.concatenate([corners[k] + ts * (corners[(k + 1) % 3] - corners[k]) for k in range(3)])
            squared = ((outline - point) ** 2).sum(axis=1).min()
            turns = [np.linalg.det([corners[(k + 1) % 3] - corners[k], point - corners[k]]) for k in range(3)]
            inside = min(turns) > 0 or max(turns) < 0
            expected = 1 / (1 + np.exp(-squared / 0.09 if inside else squared / 0.09))
            if expected > 1e-4:
                assert got[row, column] == pytest.approx(expected, abs=1e-5)
            else:
                assert got[row, column] < 1e-4


def test_the_order_of_corners_does_not_matter():
    first, second = (soft_coverage(one, LATTICE, 0.3).union() for one in (TRIANGLES, TRIANGLES.flip(1)))
    np.testing.assert_allclose(first, second, atol=1e-12)


def test_shares_of_a_triangle_add_up_to_one_however_small_it_is():
    tiny = torch.tensor([[[0.4, 0.05], [0.41, 0.05], [0.4, 0.06]]], dtype=torch.float64)  # between pixels
    for softness in (1e-3, 0.02, 0.5):
        coverage = soft_coverage(tiny, LATTICE, softness)
        assert coverage.onto_faces(coverage.shares()).item() == pytest.approx(1, abs=1e-9)


def test_what_lies_far_away_has_no_pairs():
    coverage = soft_coverage(TRIANGLES + 100.0, LATTICE, 0.3)
    assert len(coverage.face) == 0
    assert (coverage.union() == 0).all()


def test_batches_change_nothing(monkeypatch):
    corners = torch.rand(40, 3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4 - 2

    def result() -> tuple[torch.Tensor, torch.Tensor]:
        free = corners.clone().requires_grad_()
        union = soft_coverage(free, LATTICE, 0.2).union()
        (gradient,) = torch.autograd.grad((union * torch.arange(len(union))).sum(), free)
        return union.detach(), gradient

    whole = result()
    monkeypatch.setattr(soft_raster, "_PAIRS_AT_ONCE", 57)
    for one, other in zip(whole, result(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_gradients_are_those_of_finite_differences():
    def scalar(corners: torch.Tensor) -> torch.Tensor:
        coverage = soft_coverage(corners, LATTICE, 0.3)
        weights = torch.arange(coverage.pixels, dtype=corners.dtype).cos()
        opacity = torch.tensor([0.4, 0.9], dtype=corners.dtype)
        return (coverage.union(opacity) * weights).sum() + (coverage.onto_pixels(coverage.shares()) * weights).sum()

    assert torch.autograd.gradcheck(scalar, TRIANGLES.clone().requires_grad_(), eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("template", "vertices"),
    [
        *((icosphere(1), 12), (icosphere(3), 92), (icosphere(8), 642)),
        *((cube_sphere(1), 8), (cube_sphere(4), 98), (cube_sphere(15), 1352)),
    ],
)
def test_templates_are_closed_and_turned_outwards_with_faces_of_similar_size(template, vertices):
    faces = 2 * vertices - 4
    assert (template.vertices.shape, template.faces.shape) == ((vertices, 3), (faces, 3))
    assert len(template.edges) == len(template.flaps) == faces * 3 // 2
    np.testing.assert_allclose(np.linalg.norm(template.vertices, axis=1), 1)
    a, b, c = template.vertices[template.faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    assert ((across * a).sum(axis=1) > 0).all()
    areas = np.linalg.norm(across, axis=1) / 2
    assert areas.max() < 2 * areas.min()
    if vertices > 600:  # the published numbers
        assert areas.sum() == pytest.approx(4 * np.pi, rel=0.01)
    directed = {(int(face[k]), int(face[(k + 1) % 3])) for face in template.faces for k in range(3)}
    assert len(directed) == 3 * len(template.faces)  # neighbours go along their edge in opposite directions
    assert {(b, a) for a, b in directed} == directed
    for edge, flap in zip(template.edges, template.flaps, strict=True):
        shared = set(template.faces[flap[0]].tolist()) & set(template.faces[flap[1]].tolist())
        assert shared == set(edge.tolist())
