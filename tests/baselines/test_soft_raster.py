"""Soft coverage of pixels by triangles against closed forms and finite differences; closed template meshes."""

import numpy as np
import pytest
import torch

from sarsplat.baselines import soft_raster
from sarsplat.baselines.meshes import cube_sphere, icosphere
from sarsplat.baselines.soft_raster import Lattice, soft_coverage
from sarsplat.geometry import ImageGrid

LATTICE = Lattice.of(ImageGrid(12, 9, (0.5, 0.25), (1.0, 1.0), (0.3, -0.2)))
TRIANGLES = torch.tensor(
    [[[-1.0, -0.7], [1.1, -0.6], [0.2, 1.0]], [[0.4, 0.1], [0.3, -1.0], [2.0, 0.2]]], dtype=torch.float64
)


def dense(values: torch.Tensor, coverage: soft_raster.Coverage, face: int) -> np.ndarray:
    image = torch.zeros(coverage.pixels + 1, dtype=values.dtype)
    chosen = coverage.face == face
    image[coverage.pixel[chosen]] = values[chosen]
    return image[:-1].reshape(LATTICE.rows, LATTICE.columns).numpy()


def test_coverage_is_the_sigmoid_of_the_squared_distance_to_the_outline():
    coverage = soft_coverage(TRIANGLES, LATTICE, 0.3)
    got = dense(torch.sigmoid(coverage.signed), coverage, 0)
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


@pytest.mark.parametrize(("template", "vertices", "faces"), [(icosphere(8), 642, 1280), (cube_sphere(15), 1352, 2700)])
def test_the_published_numbers_of_vertices_and_faces_of_similar_size(template, vertices, faces):
    assert template.vertices.shape == (vertices, 3)
    assert template.faces.shape == (faces, 3)
    assert len(template.edges) == len(template.flaps) == faces * 3 // 2
    a, b, c = template.vertices[template.faces].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert areas.max() < 2 * areas.min()
    assert areas.sum() == pytest.approx(4 * np.pi, rel=0.01)


@pytest.mark.parametrize("template", [icosphere(1), icosphere(3), cube_sphere(1), cube_sphere(4), cube_sphere(15)])
def test_they_are_closed_and_turned_outwards(template):
    np.testing.assert_allclose(np.linalg.norm(template.vertices, axis=1), 1)
    assert len(template.vertices) - len(template.edges) + len(template.faces) == 2
    a, b, c = template.vertices[template.faces].transpose(1, 0, 2)
    assert ((np.cross(b - a, c - a) * a).sum(axis=1) > 0).all()
    directed = {(int(face[k]), int(face[(k + 1) % 3])) for face in template.faces for k in range(3)}
    assert len(directed) == 3 * len(template.faces)  # neighbours go along their edge in opposite directions
    assert {(b, a) for a, b in directed} == directed
    for edge, flap in zip(template.edges, template.flaps, strict=True):
        shared = set(template.faces[flap[0]].tolist()) & set(template.faces[flap[1]].tolist())
        assert shared == set(edge.tolist())
