"""Random points of a surface, as trimesh draws them."""

import numpy as np
import pytest
import trimesh

from sarsplat.scenes.surface_samples import blocks_of_samples, surface_samples


@pytest.mark.parametrize("count", [1, 40_000])
def test_they_are_those_of_trimesh(count: int) -> None:
    mesh = trimesh.creation.icosphere(3)
    mesh.vertices[:, 0] *= 50.0  # faces of very different areas
    places, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    np.testing.assert_array_equal(surface_samples(mesh, count, np.random.default_rng(0)), places)
    blocks = blocks_of_samples(mesh, count, np.random.default_rng(0))
    np.testing.assert_array_equal(np.concatenate([face for _, _, face in blocks]), faces)


def test_weights_and_a_generator_in_use_are_taken() -> None:
    mesh = trimesh.creation.box()
    weight, chances = mesh.area_faces * (np.arange(12) == 7), [np.random.default_rng(0) for _ in range(2)]
    for _ in range(2):
        places, _ = trimesh.sample.sample_surface(mesh, 1000, weight, seed=chances[0])
        np.testing.assert_array_equal(surface_samples(mesh, 1000, chances[1], weight), places)


def test_a_mesh_without_area_has_points_as_well() -> None:
    point = trimesh.Trimesh([[1.0, 2.0, 3.0]] * 3, [[0, 1, 2]], process=False)
    np.testing.assert_array_equal(surface_samples(point, 2, np.random.default_rng(0)), [[1.0, 2.0, 3.0]] * 2)
