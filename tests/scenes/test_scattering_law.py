import numpy as np
import pytest

from sarsplat.scenes import ScatteringLaw
from sarsplat.scenes.scattering import part_reflectivity

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
