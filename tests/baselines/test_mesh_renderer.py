"""A mesh as the radar sees it: closed forms, ray casting, invariances, finite differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from made import overlap
from sarsplat.baselines.mesh_renderer import Layers, MeshRenderer
from sarsplat.baselines.meshes import cube_sphere, icosphere
from sarsplat.geometry import ImageGrid, View, radar_frame

GRID = ImageGrid(44, 36, (0.25, 0.3), (0.25, 0.3), (0.1, -0.2))
VIEW = View(20, 30)
SHARP = MeshRenderer(GRID, 0.05, 0.03)
SOFT = MeshRenderer(GRID, 0.15, 0.1)

Mesh = tuple[np.ndarray, np.ndarray]


def facing_plate(side: float, away: float, up: float = 0.0, parts: int = 8) -> Mesh:
    """A square that the radar of VIEW sees face on, at a range."""
    x, y, z = radar_frame(VIEW)
    steps = side * np.linspace(-0.5, 0.5, parts + 1)
    u, v = (one.ravel() for one in np.meshgrid(steps, steps, indexing="ij"))
    number = np.arange(len(u)).reshape(parts + 1, -1)
    a, b, c, d = (number[i : i + parts, j : j + parts].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return away * z + up * y + u[:, None] * y + v[:, None] * x, faces


def box(sides: tuple[float, float, float], bottom: tuple[float, float, float] = (0.5, 0, 0)) -> Mesh:
    """An upright box."""
    template = cube_sphere(6)
    cube = np.tan(template.vertices / np.abs(template.vertices).max(axis=1, keepdims=True) * np.pi / 4)
    return cube / 2 * sides + bottom + (0, 0, sides[2] / 2), template.faces


def layers(renderer: MeshRenderer, mesh: Mesh, view: View = VIEW, gamma0: float | torch.Tensor = 1.0) -> Layers:
    points, faces = (torch.from_numpy(one) for one in mesh)
    return renderer.layers(points, faces, torch.ones(len(faces), dtype=points.dtype) * gamma0, view)


@pytest.mark.parametrize("renderer", [SHARP, SOFT])
def test_a_plate_facing_the_radar_returns_its_area_from_its_range(renderer):
    image = layers(renderer, facing_plate(3.0, 1.2, parts=11), gamma0=0.7)
    power_m2 = image.target.sum().item() * math.prod(GRID.spacing_m)
    assert power_m2 == pytest.approx(0.7 * 9.0, rel=0.04)  # ripple of samples as far apart as the response
    assert image.sections.sum().item() == pytest.approx(0.7 * 9.0, rel=1e-3)
    target = image.target.numpy()
    assert (target.sum(axis=1) @ GRID.range_m) / target.sum() == pytest.approx(1.2, abs=0.03)
    across = target.sum(axis=0) * math.prod(GRID.spacing_m)
    np.testing.assert_allclose(across[np.abs(GRID.azimuth_m) < 1.0], 0.7 * 3.0 * GRID.spacing_m[0], rtol=0.08)
    assert across[np.abs(GRID.azimuth_m) > 2.4].sum() < 1e-3


def test_the_back_of_a_face_is_not_seen():
    points, faces = facing_plate(3.0, 0.0)
    image = layers(SOFT, (points, faces[:, ::-1].copy()))
    assert not image.sections.any()
    assert not image.target.any()
    assert not image.lit.any()


@pytest.mark.parametrize("renderer", [SHARP, SOFT])
@pytest.mark.parametrize(("up", "side", "seen"), [(0.0, 2.0, 0.0), (-2.0, 3.0, 4.5)], ids=["all", "half"])
def test_what_is_hidden_gets_no_illumination(renderer, up, side, seen):
    front, behind = facing_plate(4.0, -1.0, up), facing_plate(side, 1.0)
    count = len(front[1])
    image = layers(
        renderer, (np.concatenate([front[0], behind[0]]), np.concatenate([front[1], behind[1] + len(front[0])]))
    )
    assert image.sections[:count].sum().item() == pytest.approx(16.0, rel=1e-3)
    # some light comes through the soft seams between faces
    assert image.sections[count:].sum().item() == pytest.approx(seen, rel=0.15, abs=0.2)


@pytest.mark.parametrize("view", [VIEW, View(250, 45), View(3, 17), View(100, 75)], ids=str)
def test_all_of_a_ball_that_faces_the_radar_is_seen(view):
    """A convex body hides nothing of its own: its cross-section is its outline's area."""
    template = icosphere(8)
    image = layers(SOFT, (template.vertices * 1.8 + (0, 0, 2.0), template.faces), view)
    assert image.sections.sum().item() == pytest.approx(math.pi * 1.8**2, rel=0.02)


@pytest.mark.parametrize("view", [VIEW, View(250, 45), View(45, 15)], ids=str)
@pytest.mark.parametrize("sides", [(4, 2, 1.5), (2.5, 2.5, 2.5)])
def test_masks_of_a_box_are_those_of_ray_casting(view, sides):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    from sarsplat.scenes.raycast import raycast_mask

    mesh = box(sides)
    true = raycast_mask(trimesh.Trimesh(*mesh, process=False), view, GRID)
    image = layers(SHARP, mesh, view)
    lit = (image.lit > 0.5).numpy()
    assert overlap(lit, true == 1) > 0.85
    assert overlap((image.hidden > 0.5).numpy() & ~lit, true == 2) > 0.85


@pytest.mark.parametrize("turn", [37.0, -120.0])
def test_turning_scene_and_view_together_changes_nothing(turn):
    points, faces = box((4, 2, 1.5))
    angle = math.radians(turn)
    turned = points @ np.array(
        [[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    first, second = layers(SOFT, (points, faces)), layers(SOFT, (turned, faces), View(20 - turn, 30))
    for name in ("target", "lit", "hidden", "sections"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-7, atol=1e-9)


def test_moving_by_whole_pixels_moves_the_image():
    mesh = box((2, 1.5, 1))
    x, _, z = radar_frame(VIEW)
    first = layers(SOFT, mesh)
    # along the ground: two pixels across, three along, which is farther on the ground than in range
    ground = np.array([z[0], z[1], 0]) / math.cos(math.radians(30))
    step = 2 * GRID.spacing_m[0] * x + 3 * GRID.spacing_m[1] / math.cos(math.radians(30)) * ground
    second = layers(SOFT, (mesh[0] + step, mesh[1]))
    np.testing.assert_allclose(second.hidden.numpy()[3:, 2:], first.hidden.numpy()[:-3, :-2], atol=1e-6)
    np.testing.assert_allclose(second.target.numpy()[3:, 2:], first.target.numpy()[:-3, :-2], atol=0.05)


def test_a_wider_response_spreads_the_same_power():
    mesh, grid = box((1, 1, 1), (0, 0, 0)), replace(GRID, center_m=(0.0, 0.0))
    first, second = (
        layers(replace(SOFT, grid=replace(grid, resolution_m=resolution)), mesh).target.numpy()
        for resolution in ((0.25, 0.3), (0.75, 0.6))
    )
    assert second.sum() == pytest.approx(first.sum(), rel=1e-3)
    offsets = grid.azimuth_m

    def variance(image: np.ndarray) -> float:
        across = image.sum(axis=0) / image.sum()
        return float(across @ offsets**2 - (across @ offsets) ** 2)

    missing = 0.75**2 / (8 * math.log(2)) - 0.15**2
    assert variance(second) - variance(first) == pytest.approx(missing, rel=0.05)


def test_gradients_are_those_of_finite_differences(monkeypatch):
    """With what faces hide of each other held fixed."""
    template = icosphere(1)
    generator = torch.Generator().manual_seed(1)
    points = torch.from_numpy(template.vertices) * torch.tensor([1.1, 0.7, 0.6]) + torch.tensor([0.1, 0.0, 0.7])
    points = points + 0.05 * torch.rand(points.shape, generator=generator, dtype=points.dtype)
    gamma0 = 0.5 + torch.rand(len(template.faces), generator=generator, dtype=points.dtype)
    renderer = MeshRenderer(ImageGrid(11, 13, (0.4, 0.35), (0.5, 0.5)), 0.3, 0.2)
    faces = torch.from_numpy(template.faces)
    normals = torch.linalg.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    facing = int((normals @ torch.from_numpy(VIEW.direction) > 0).sum())
    visible = 0.2 + 0.8 * torch.rand(facing, generator=generator, dtype=points.dtype)
    monkeypatch.setattr(MeshRenderer, "_visible", lambda *_: visible)

    def scalar(points: torch.Tensor, gamma0: torch.Tensor) -> torch.Tensor:
        image = renderer.layers(points, faces, gamma0, VIEW)
        weights = torch.arange(image.lit.numel(), dtype=points.dtype).cos().reshape(image.lit.shape)
        return (weights * (image.target + image.lit + image.shadow)).sum()

    inputs = (points.requires_grad_(), gamma0.requires_grad_())
    assert torch.autograd.gradcheck(scalar, inputs, atol=1e-6, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
def test_from_the_left_it_is_right_mirrored(tilt_deg: float) -> None:
    mesh, renderer = box((2.0, 1.5, 1.0)), replace(SHARP, grid=replace(GRID, center_m=(0.0, GRID.center_m[1])))
    gamma0 = torch.linspace(0.1, 1.0, len(mesh[1]), dtype=torch.float64)
    left, right = (
        layers(renderer, mesh, view, gamma0) for view in (View(20, 30, tilt_deg, "left"), View(20, 30, -tilt_deg))
    )
    for name in ("target", "lit", "hidden"):
        expected = getattr(right, name).flip(1)
        assert float(expected.max()) > 0.05
        torch.testing.assert_close(getattr(left, name), expected, rtol=1e-9, atol=1e-12)
