"""The template meshes are closed spheres of the numbers of vertices that were published."""

import numpy as np
import pytest

from sarsplat.baselines.meshes import cube_sphere, icosphere


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
