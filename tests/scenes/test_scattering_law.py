"""Laws of scattering and speckle, and the splat truth."""

import math

import numpy as np
import pytest

from sarsplat import ImageGrid, View
from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.geometry.responses import TAYLOR
from sarsplat.scenes import ScatteringLaw, law_scattering, surface_gaussians, target_mesh
from sarsplat.scenes.scattering import ResponseSpeckle, part_reflectivity, white_speckle

trimesh = pytest.importorskip("trimesh")


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (ScatteringLaw(0.1, 0.9), [1.0, 1.0, 0.325, 0.325, 0.1]),  # two-sided
        (ScatteringLaw(0.3, 0.0), [0.3] * 5),
        (ScatteringLaw(0.0, 2.0, 1.0), [2.0, 2.0, 1.0, 1.0, 0.0]),  # Lambert: σ⁰ = γ⁰·cos i ∝ cos²i
        (ScatteringLaw(0.1, 2.56, 8), [2.66, 2.66, 0.11, 0.11, 0.1]),
    ],
)
def test_law_is_floor_plus_lobe(law, expected):
    np.testing.assert_allclose(law.gamma0(np.array([1.0, -1.0, 0.5, -0.5, 0.0])), expected)


def test_the_parts_of_a_mesh_differ_in_reflectivity():
    parts = [trimesh.creation.box((1, 1, 1)).apply_translation((2 * k, 0, 0)) for k in range(300)]
    mesh = trimesh.util.concatenate(parts)
    mesh.unmerge_vertices()  # as an STL file has them
    factors = part_reflectivity(mesh, 3.0, seed=1).reshape(300, 12)
    assert (factors == factors[:, :1]).all()
    decibels = 10 * np.log10(factors[:, 0])
    assert decibels.std() == pytest.approx(3.0, rel=0.1)
    assert decibels.mean() == pytest.approx(0.0, abs=0.5)
    assert (part_reflectivity(mesh, 3.0, seed=2) != factors.ravel()).all()
    assert (part_reflectivity(mesh, 0.0, seed=1) == 1.0).all()


GRID = ImageGrid(96, 128, (0.2, 0.25), (0.32, 0.3), response=TAYLOR)


def lag(power: np.ndarray, axis: int) -> float:
    """Correlation of the power of neighbours."""
    away = np.moveaxis(power - power.mean(), axis, -1)
    return float((away[..., 1:] * away[..., :-1]).mean() / (away**2).mean())


def expected(spacing_m: float, width_m: float) -> float:
    """From the window alone: the squared transform of its squares."""
    places = (np.arange(512) + 0.5) / 512 - 0.5
    window = TAYLOR.window(places)
    band = TAYLOR.width / width_m  # cycles per metre
    return float(((window**2 * np.cos(2 * np.pi * places * band * spacing_m)).sum() / (window**2).sum()) ** 2)


def test_neighbours_are_as_alike_as_the_window_says() -> None:
    speckle, rng = ResponseSpeckle(GRID), np.random.default_rng(0)
    drawn = np.stack([speckle.draw(rng) for _ in range(30)])
    assert drawn.dtype == np.complex64
    power = np.abs(drawn) ** 2
    assert power.mean() == pytest.approx(1, abs=0.01)
    assert power.std() == pytest.approx(1, abs=0.02)  # as exponential power has it
    assert abs((drawn**2).mean()) < 0.01  # all phases are as likely
    assert lag(power, 1) == pytest.approx(expected(0.25, 0.3), abs=0.015)
    assert lag(power, 2) == pytest.approx(expected(0.2, 0.32), abs=0.015)


def test_white_speckle_is_white() -> None:
    power = np.abs(white_speckle((200, 300), np.random.default_rng(1))) ** 2
    assert (power.mean(), lag(power, 0), lag(power, 1)) == pytest.approx((1, 0, 0), abs=0.02)


# ---- surface Gaussians of the splat truth ----------------------------------------------------------------------------
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
    mesh = target_mesh("slicy")
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


def test_scattering_follows_the_law_in_every_view():
    views = [View(0, 30), View(90, 60)]
    normals = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]], dtype=float)
    expected = 0.1 + 0.9 * np.array([[0.25, 0.25, 0.75, 0.0], [0.75, 0.75, 0.0, 0.25]])
    np.testing.assert_allclose(law_scattering(normals, views, ScatteringLaw(0.1, 0.9)), expected, atol=1e-12)
