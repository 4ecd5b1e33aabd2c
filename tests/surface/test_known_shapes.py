"""Normals and meshes of shapes that are known: noisy points, among Gaussians that are as uncertain."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from sarsplat import Gaussians, Harmonics
from sarsplat.evaluation import Yardstick, point_metrics
from sarsplat.evaluation.points import on_surface
from sarsplat.surface.mesh import surface_mesh
from sarsplat.surface.normals import surface_normals
from sarsplat.surface.visibility import Seen

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")
pytest.importorskip("fcpw")

CELL_M = 0.3
NOISE_M, TILT = 0.025, 0.15  # standard deviations: of points across the surface, and of axes

SHAPES = {
    "ball": lambda: trimesh.creation.icosphere(subdivisions=5, radius=1.5),
    "box": lambda: trimesh.creation.box((3.0, 2.0, 1.2)),
    "barrel": lambda: trimesh.creation.cylinder(0.1, 3.0, sections=64),  # two thirds of a cell thick
}


class Known:
    """A shape, noisy points of it, their normals, and the mesh through them."""

    def __init__(self, name: str) -> None:
        self.truth = SHAPES[name]()
        chance = np.random.default_rng(0)

        def drawn(per_m2: float) -> tuple[np.ndarray, np.ndarray]:
            places, faces = trimesh.sample.sample_surface(self.truth, round(per_m2 * self.truth.area), seed=chance)
            return places, self.truth.face_normals[faces]

        points, outwards = drawn(1500.0)
        self.points = points + outwards * chance.normal(0, NOISE_M, (len(points), 1))
        means, axes = drawn(120.0)
        axes = axes + chance.normal(0, TILT, axes.shape)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        # the turn of the z axis to the normal: (1 + z, z × n), not normalised
        turns = np.column_stack([1 + axes[:, 2], -axes[:, 1], axes[:, 0], np.zeros(len(axes))])
        count = len(means)
        gaussians = Gaussians(
            torch.tensor(means + axes * chance.normal(0, NOISE_M, (count, 1)), dtype=torch.float32),
            torch.tensor(turns, dtype=torch.float32),
            torch.tensor([0.08, 0.06, 0.02]).repeat(count, 1),
            torch.ones(count),
            Harmonics(torch.zeros(count, 1)),
        )
        whole = torch.ones(count, dtype=torch.float64)
        seen = Seen(torch.tensor(means), whole, whole, torch.tensor(axes), CELL_M / 4)
        self.normals = surface_normals(self.points, outwards, gaussians, CELL_M)
        self.alone = surface_normals(self.points, outwards, gaussians[:0], CELL_M)
        self.mesh: Any = surface_mesh(self.points, self.normals, seen, CELL_M)

    def off_deg(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        across = on_surface(places, np.asarray(self.truth.triangles))[1]
        return np.degrees(np.arccos(np.abs(np.einsum("pc,pc->p", across, normals)).clip(0, 1)))


@pytest.fixture(scope="module", params=SHAPES)
def known(request: pytest.FixtureRequest) -> tuple[str, Known]:
    return request.param, Known(request.param)


def test_normals_of_noisy_points(known: tuple[str, Known]) -> None:
    name, shape = known
    off = shape.off_deg(shape.points, shape.normals)
    median, wrong = {"ball": (5, 0.01), "box": (5, 0.08), "barrel": (13, 0.2)}[name]
    assert np.median(off) < median
    assert (off > 30).mean() < wrong
    if name != "barrel":
        assert off.mean() < shape.off_deg(shape.points, shape.alone).mean()


def test_the_mesh_is_smooth_whole_and_near(known: tuple[str, Known]) -> None:
    name, shape = known
    samples, faces = trimesh.sample.sample_surface(shape.mesh, 20_000, seed=0)
    off = shape.off_deg(samples, shape.mesh.face_normals[faces])
    median, wrong = {"ball": (6, 0.02), "box": (6, 0.15), "barrel": (20, 0.35)}[name]
    assert np.median(off) < median
    assert (off > 30).mean() < wrong
    truth = trimesh.sample.sample_surface(shape.truth, 20_000, seed=0)[0]
    scores = point_metrics(samples, np.asarray(shape.truth.triangles), truth, Yardstick(CELL_M))
    assert scores.accuracy_m < 0.6 * NOISE_M
    assert scores.f1[0.1] > 0.99
    assert len(shape.mesh.split(only_watertight=False)) == 1
    assert shape.mesh.is_winding_consistent
    if name == "box":  # edges are not rounded off: half a voxel at most, on average
        along = np.linspace(-1.4, 1.4, 200)
        edge = np.column_stack([along, np.full(200, 1.0), np.full(200, 0.6)])
        from_edge = on_surface(edge, np.asarray(shape.mesh.triangles))[0]
        assert from_edge.mean() < 0.04


def test_the_number_of_threads_changes_no_bit(known: tuple[str, Known], monkeypatch: pytest.MonkeyPatch) -> None:
    name, shape = known
    if name != "barrel":
        pytest.skip("one shape does")
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if before > 1 else 3)
        again = Known(name)
    finally:
        torch.set_num_threads(before)
    assert again.normals.tobytes() == shape.normals.tobytes()
    assert np.asarray(again.mesh.vertices).tobytes() == np.asarray(shape.mesh.vertices).tobytes()
