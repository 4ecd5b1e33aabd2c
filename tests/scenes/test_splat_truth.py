"""Surface Gaussians for protocol R-self."""

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from sarsplat.errors import SarsplatError
from sarsplat.geometry import View
from sarsplat.scenes import ScatteringLaw, law_scattering, surface_gaussians, vehicle

trimesh = pytest.importorskip("trimesh")


def test_points_lie_on_the_surface_evenly_with_their_normals():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    gaussians, normals = surface_gaussians(sphere, 3000)
    means = gaussians.means.double().numpy()
    assert abs(len(gaussians) / 3000 - 1) < 0.08
    np.testing.assert_allclose(np.linalg.norm(means, axis=1), 2.0, atol=5e-3)
    np.testing.assert_allclose(normals, means / 2.0, atol=0.05)
    spacing = np.sqrt(sphere.area / len(gaussians))
    nearest = KDTree(means).query(means, k=2)[0][:, 1]
    assert nearest.min() > 0.6 * spacing  # random points would come as close as 0.01
    samples = trimesh.sample.sample_surface(sphere, 5000, seed=1)[0]
    assert KDTree(means).query(samples)[0].max() < 1.1 * spacing  # and leave holes twice as wide


def test_thin_plates_are_covered_on_both_sides():
    plate = trimesh.creation.box((6, 6, 0.02))
    gaussians, normals = surface_gaussians(plate, 4000)
    assert abs(len(gaussians) / 4000 - 1) < 0.08
    assert abs((normals[:, 2] > 0.5).mean() - 0.5) < 0.03


def test_parameters_and_reproducibility():
    mesh = vehicle("t72")
    first, normals = surface_gaussians(mesh, 2000, sigma=0.07, optical_depth=3.0, seed=4)
    again, _ = surface_gaussians(mesh, 2000, sigma=0.07, optical_depth=3.0, seed=4)
    other, _ = surface_gaussians(mesh, 2000, seed=5)
    assert torch.equal(first.means, again.means)
    assert first.means.shape != other.means.shape or not torch.equal(first.means, other.means)
    assert abs(len(first) / 2000 - 1) < 0.1
    assert (first.scales == 0.07).all() and (first.optical_depth == 3.0).all()
    assert normals.shape == (len(first), 3) and normals.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-9)


def test_scattering_follows_the_law_in_every_view():
    law = ScatteringLaw(0.1, 0.9)
    views = [View(0, 30), View(90, 60)]
    normals = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]], dtype=float)
    expected = 0.1 + 0.9 * np.array([[0.25, 0.25, 0.75, 0.0], [0.75, 0.75, 0.0, 0.25]])
    np.testing.assert_allclose(law_scattering(normals, views, law), expected, atol=1e-12)


def test_impossible_requests_are_refused():
    with pytest.raises(SarsplatError, match="count 0"):
        surface_gaussians(trimesh.creation.box((1, 1, 1)), 0)
    with pytest.raises(SarsplatError, match="no points"):
        surface_gaussians(trimesh.Trimesh(), 10)
