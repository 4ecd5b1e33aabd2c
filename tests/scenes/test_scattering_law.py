"""Laws of scattering, and speckle through the response: of power 1, exponential, and as alike as the window says."""

from __future__ import annotations

import numpy as np
import pytest

from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR
from sarsplat.scenes import ScatteringLaw
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


def test_a_gaussian_response_correlates_as_a_gaussian() -> None:
    grid = ImageGrid(64, 64, (0.2, 0.2), (0.3, 0.3), response=GAUSSIAN)
    rng = np.random.default_rng(0)
    power = np.stack([np.abs(ResponseSpeckle(grid).draw(rng)) ** 2 for _ in range(40)])
    # h is a Gaussian of twice the variance of |h|²; its correlation of four times, and squared of twice
    assert lag(power, 1) == pytest.approx(2 ** -(2 * (0.2 / 0.3) ** 2), abs=0.02)


def test_white_speckle_is_white() -> None:
    power = np.abs(white_speckle((200, 300), np.random.default_rng(1))) ** 2
    assert power.mean() == pytest.approx(1, abs=0.02)
    assert abs(lag(power, 0)) < 0.02
    assert abs(lag(power, 1)) < 0.02
