"""SLICY: its size and the places of its parts."""

from __future__ import annotations

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh")

from sarsplat.scenes import target_mesh  # noqa: E402


@pytest.fixture(scope="module")
def mesh():
    return target_mesh("slicy")


def test_size_and_place(mesh):
    np.testing.assert_allclose(mesh.bounds, [[-1.2225, -1.375, 0], [1.2225, 1.375, 1.689]])


def test_a_tall_closed_cylinder_a_short_open_one_and_a_corner_stand_on_the_roof(mesh):
    def height(x, y):
        hits, *_ = mesh.ray.intersects_location([[x, y, 5.0]], [[0, 0, -1.0]])
        return hits[:, 2].max()

    assert height(-0.4933, 0.5838) == pytest.approx(1.689)  # closed
    assert height(-0.4933, -0.5821) == pytest.approx(0.774)  # one looks through the tube
    assert mesh.vertices[np.abs(mesh.vertices[:, 2] - 1.232) < 1e-9].shape[0] >= 24  # its rim
    assert height(1.1, -1.0) == pytest.approx(0.4604)  # the step
    assert height(0.9089, 0.3) == pytest.approx(0.774, abs=0.001)  # the lying cylinder is as high as the roof
    assert mesh.vertices[np.abs(mesh.vertices[:, 2] - 1.0667) < 1e-9].shape[0] >= 1  # the corner's third leg


def test_the_corner_opens_towards_the_step(mesh):
    *_, corner = mesh.split(only_watertight=False, repair=False)
    assert len(corner.faces) == 3
    normals = corner.face_normals
    np.testing.assert_allclose(np.abs(normals @ normals.T), np.eye(3), atol=1e-6)  # at right angles to each other
    apex = np.array([0.1659, 0.3783, 0.774])
    assert (corner.vertices[:, 0] >= apex[0] - 1e-9).all()
    assert np.linalg.norm(corner.vertices - apex, axis=1) == pytest.approx([0, 0.2927, 0.2927, 0.2927], abs=1e-4)
