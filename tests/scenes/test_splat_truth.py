"""Surface Gaussians of the splat truth."""

import math

import numpy as np
import pytest

from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.geometry import View
from sarsplat.scenes import ScatteringLaw, law_scattering, simulate_raycast, surface_gaussians, target_mesh
from sarsplat.scenes.protocols import paper_grid
from sarsplat.scenes.simulate import simulate_images

trimesh = pytest.importorskip("trimesh")


def depths_and_areas(gaussians):
    """Optical depth times footprint, m², of every Gaussian seen along its normal."""
    scales = gaussians.scales.double()
    return (2 * math.pi * gaussians.optical_depth.double() * scales[:, 1] * scales[:, 2]).numpy()


def test_every_face_is_covered_in_proportion_to_its_area():
    mesh = trimesh.creation.cylinder(radius=0.8, height=5.0, sections=20)  # needles and large faces
    gaussians, faces = surface_gaussians(mesh, 0.05)
    depth = np.bincount(faces, depths_and_areas(gaussians), len(mesh.faces)) / mesh.area_faces
    np.testing.assert_allclose(depth, 7.0, rtol=0.02)  # no Gaussian is narrower than it is thick


def test_gaussians_keep_the_centre_and_lie_in_the_face():
    mesh = target_mesh("t72")
    gaussians, faces = surface_gaussians(mesh, 0.1)
    weight = depths_and_areas(gaussians)
    np.testing.assert_allclose(np.average(gaussians.means, axis=0, weights=weight), mesh.centroid, atol=5e-3)
    offset = ((gaussians.means.double().numpy() - mesh.triangles_center[faces]) * mesh.face_normals[faces]).sum(1)
    assert np.abs(offset).max() < 1e-5
    assert float(gaussians.scales.max()) <= 0.29 * 0.1
    normals = rotation_matrix(gaussians.quaternions.double())[:, :, 0].numpy()
    wide = gaussians.scales[:, 1].numpy() > 2e-3  # thinner than that, a needle has no plane
    cosine = np.abs((normals * mesh.face_normals[faces]).sum(1))[wide]
    assert cosine.min() > 1 - 1e-4


def test_second_moments_are_those_of_the_pieces():
    right = trimesh.Trimesh([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]], [[0, 1, 2]], process=False)
    (gaussians, _), side = surface_gaussians(right, 1.0), 0.3
    assert len(gaussians) == 1
    # of a right isosceles triangle with legs a, about its centre: a²/12 and a²/36 along its axes
    expected = 1.2 * np.array([side / math.sqrt(36), side / math.sqrt(12)])
    np.testing.assert_allclose(gaussians.scales[0, 1:], expected, rtol=1e-5)


def test_a_vehicle_looks_the_same_to_both_forward_models():
    pytest.importorskip("embreex")
    mesh, view, grid = target_mesh("t72"), View(30.0, 45.0), paper_grid()
    truth = np.sqrt(simulate_raycast(mesh, view, grid, ScatteringLaw()).astype(float))
    splat = np.sqrt(simulate_images(mesh, [view], grid, source="splat")[0].astype(float))
    mask = truth > truth.max() * 10 ** (-30 / 20)
    psnr = -10 * math.log10(np.mean((splat - truth)[mask] ** 2) / truth.max() ** 2)
    assert psnr >= 40.0


def test_scattering_follows_the_law_in_every_view():
    views = [View(0, 30), View(90, 60)]
    normals = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]], dtype=float)
    expected = 0.1 + 0.9 * np.array([[0.25, 0.25, 0.75, 0.0], [0.75, 0.75, 0.0, 0.25]])
    np.testing.assert_allclose(law_scattering(normals, views, ScatteringLaw(0.1, 0.9)), expected, atol=1e-12)
