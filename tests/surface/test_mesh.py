"""The surface as points with normals and as a mesh: of a ball that is bright on one side, and of known shapes."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from made import upright
from sarsplat import Gaussians, ImageGrid, SarsplatError, View, extract_points
from sarsplat.data import write_mesh
from sarsplat.evaluation import Yardstick, point_metrics
from sarsplat.evaluation.points import on_surface
from sarsplat.gaussians.law_harmonics import CONSTANTS
from sarsplat.scenes import surface_gaussians
from sarsplat.scenes.meshes import read_mesh
from sarsplat.settings.sections import PointExtraction
from sarsplat.surface.mesh import surface_mesh
from sarsplat.surface.normals import surface_normals
from sarsplat.surface.visibility import Seen

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")

GRID = ImageGrid(32, 32, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 45) for grazing in (20.0, 45.0, 75.0)]
RADIUS, HEIGHT = 1.5, 2.0  # m
GAMMA0 = {True: 0.8, False: 0.2}  # by whether x is positive


class Ball(NamedTuple):
    gaussians: Gaussians
    seen: Seen
    points: np.ndarray
    normals: np.ndarray
    mesh: Any


@pytest.fixture(scope="module")
def ball() -> Ball:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS).apply_translation((0, 0, HEIGHT))
    gaussians = surface_gaussians(sphere, 0.2)[0]
    gamma0 = torch.where(gaussians.means[:, :1] > 0, GAMMA0[True], GAMMA0[False])
    gaussians = gaussians.with_tensors(scattering=gamma0.expm1().log() / CONSTANTS[0])
    seen = Seen.of(gaussians, VIEWS, GRID)
    points = extract_points(gaussians, VIEWS, GRID, PointExtraction())
    normals = surface_normals(points, seen.around(points)[1], gaussians, GRID.cell_m)
    return Ball(gaussians, seen, points, normals, surface_mesh(points, normals, seen, GRID.cell_m))


def outwards_of(places: np.ndarray) -> np.ndarray:
    from_centre = places - [0, 0, HEIGHT]
    return from_centre / np.linalg.norm(from_centre, axis=1, keepdims=True)


def test_normals_of_points_point_outwards(ball: Ball) -> None:
    assert len(ball.points) > 1000
    cosine = np.einsum("pc,pc->p", ball.normals, outwards_of(ball.points))
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).mean() < 2
    assert (cosine > 0.99).mean() > 0.99  # but where the radar looks along the surface, from both sides
    np.testing.assert_allclose(np.linalg.norm(ball.normals, axis=1), 1)


def test_normals_of_a_plane_and_of_lonely_points(ball: Ball) -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(8.0), np.arange(8.0)))
    plane = np.column_stack([x, y, 0.5 * x + 1e4])  # far from the origin
    lonely = np.array([[100.0, 0, 0], [200.0, 0, 0], [300.0, 0, 0]])
    towards = np.concatenate([np.tile([0, 0, -3.0], (64, 1)), [[0, 4, 0], [0, 0, 0], [1, 0, 0]]])
    none = ball.gaussians[:0]
    normals = surface_normals(np.concatenate([plane, lonely]), towards, none, 2.5)
    np.testing.assert_allclose(normals[:64], np.tile(np.array([0.5, 0, -1]) / np.sqrt(1.25), (64, 1)), atol=1e-6)
    np.testing.assert_allclose(normals[64:], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-6)
    assert surface_normals(np.empty((0, 3)), np.empty((0, 3)), none, 1.0).shape == (0, 3)


def test_the_mesh_lies_on_the_surface_and_only_where_it_was_seen(ball: Ball) -> None:
    radius = np.linalg.norm(ball.mesh.vertices - [0, 0, HEIGHT], axis=1)
    assert np.abs(radius - RADIUS).mean() < 0.03
    assert np.abs(radius - RADIUS).max() < 0.3
    seen_area = 2 * np.pi * RADIUS**2 * (1 + np.cos(np.radians(20)))  # all but what is steeper than the lowest view
    assert ball.mesh.area == pytest.approx(seen_area, rel=0.12)
    assert ball.mesh.is_winding_consistent
    for normals, places in (
        (ball.mesh.vertex_normals, ball.mesh.vertices),
        (ball.mesh.face_normals, ball.mesh.triangles_center),
    ):
        assert (np.einsum("vc,vc->v", normals, outwards_of(places)) > 0).mean() > 0.99


def test_gamma0_of_the_vertices_is_that_of_the_gaussians_there(ball: Ball) -> None:
    gamma0, x = ball.mesh.vertex_attributes["gamma0"], ball.mesh.vertices[:, 0]
    for positive, expected in GAMMA0.items():
        inside = (x > 0.4) if positive else (x < -0.4)
        np.testing.assert_allclose(gamma0[inside], expected, rtol=1e-3)
    grey = ball.mesh.visual.vertex_colors
    assert (grey[:, 0] == grey[:, 2]).all()
    assert set(grey[x > 0.4, 0]) == {255}
    assert set(grey[x < -0.4, 0]) == {round(255 * (1 - 10 * np.log10(4) / 30))}


def test_gamma0_counts_only_views_that_see_the_place() -> None:
    """A wall that is brighter towards +x, lit from there; views from behind see another wall."""
    count = 400
    y, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 20), np.linspace(0, 2, 20)))
    means = np.concatenate([np.column_stack([np.full(count, x), y, z]) for x in (0.3, -0.3)])
    towards_x = 2.0 / np.sqrt(3 / (4 * np.pi))  # degree 1, order 1: −√(3/4π)·x
    parameters = np.zeros((2 * count, 4))
    parameters[:, 3] = -towards_x
    wall = upright(means, [0.02, 0.07, 0.07], 10.0, parameters)
    there, behind = View(0.0, 10.0), View(180.0, 10.0)
    gamma0, towards = Seen.of(wall, [there, behind], GRID).around(np.array([[0.3, 0, 1], [-0.3, 0, 1]]))
    directions = torch.tensor(np.stack([there.direction, behind.direction]), dtype=torch.float32)
    np.testing.assert_allclose(gamma0, wall.gamma0(directions)[:, 0].numpy(), rtol=0.02)
    assert towards[0, 0] > 0 > towards[1, 0]
    assert not any(seen.any() for seen in Seen.of(wall[:0], [there], GRID).around(means))


def test_what_views_see_does_not_depend_on_bricks(ball: Ball, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sarsplat.surface.visibility._MOST_BYTES", 1 << 21)
    monkeypatch.setattr("sarsplat.surface.bricks._SMALLEST", 8)
    again = Seen.of(ball.gaussians, VIEWS[:3], GRID)
    monkeypatch.undo()
    for name, expected in vars(Seen.of(ball.gaussians, VIEWS[:3], GRID)).items():
        torch.testing.assert_close(getattr(again, name), expected, rtol=1e-5, atol=1e-7)


def test_what_floats_is_left_out(ball: Ball) -> None:
    stray = np.array([3.0, 0, 3.0]) + np.random.default_rng(0).normal(scale=0.05, size=(30, 3))
    points = np.concatenate([ball.points, stray])
    normals = np.concatenate([ball.normals, np.tile([0.0, 0, 1], (30, 1))])
    mesh = surface_mesh(points, normals, ball.seen, GRID.cell_m)
    assert mesh.bounds[1][0] < RADIUS + 0.2
    assert len(mesh.faces) == pytest.approx(len(ball.mesh.faces), rel=0.01)
    assert set(np.unique(mesh.faces)) == set(range(len(mesh.vertices)))


def test_lengths_are_those_of_the_resolution_cell(ball: Ball) -> None:
    """A scene ten times as large, seen by a radar ten times as coarse, has the same mesh, ten times as large."""
    tenfold = replace(ball.seen, means=ball.seen.means * 10, radius_m=ball.seen.radius_m * 10)
    large = surface_mesh(ball.points * 10, ball.normals, tenfold, GRID.cell_m * 10)
    assert len(large.faces) == pytest.approx(len(ball.mesh.faces), rel=0.01)
    assert large.area == pytest.approx(100 * ball.mesh.area, rel=0.01)


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj", ".PLY"])
def test_files_hold_normals_and_gamma0_as_colours(ball: Ball, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"ball{ending}"
    write_mesh(path, ball.mesh)
    ours = read_mesh(path)
    assert ours.area == pytest.approx(ball.mesh.area, rel=1e-4)
    np.testing.assert_allclose(ours.bounds, ball.mesh.bounds, atol=1e-5)  # not turned
    theirs = trimesh.load_mesh(path, process=False)
    assert theirs.faces.shape == ball.mesh.faces.shape
    assert np.abs(np.int64(theirs.visual.vertex_colors) - ball.mesh.visual.vertex_colors).max() <= 1
    # trimesh makes normals of its own when it reads a mesh
    np.testing.assert_allclose(stored_normals(path), ball.mesh.vertex_normals, atol=1e-6)
    if ending == ".ply":
        gamma0 = theirs.metadata["_ply_raw"]["vertex"]["data"]["gamma0"]
        np.testing.assert_allclose(gamma0.ravel(), ball.mesh.vertex_attributes["gamma0"])


def stored_normals(path: Path) -> np.ndarray:
    """Normals of the vertices as they stand in a mesh file."""
    match path.suffix.lower():
        case ".ply":
            columns = trimesh.load_mesh(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
            return np.column_stack([columns[name].ravel() for name in ("nx", "ny", "nz")])
        case ".obj":
            rows = [line.split()[1:] for line in path.read_text().splitlines() if line.startswith("vn ")]
            return np.array(rows, dtype=float)
        case _:
            content = path.read_bytes()
            length = int.from_bytes(content[12:16], "little")  # of the JSON; eight bytes of the next head follow
            described = json.loads(content[20 : 20 + length])
            normals = described["accessors"][described["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]]
            start = 28 + length + described["bufferViews"][normals["bufferView"]].get("byteOffset", 0)
            return np.frombuffer(content, "<f4", 3 * normals["count"], start).reshape(-1, 3)


def test_what_is_no_surface_is_an_empty_mesh_and_no_file(ball: Ball, tmp_path: Path) -> None:
    for points in (np.empty((0, 3)), ball.points[:1], ball.points[:2]):
        mesh = surface_mesh(points, ball.normals[: len(points)], ball.seen, GRID.cell_m)
        assert len(mesh.faces) == 0 or mesh.area < 1
    empty = surface_mesh(np.empty((0, 3)), np.empty((0, 3)), ball.seen, GRID.cell_m)
    with pytest.raises(SarsplatError, match="has no faces"):
        write_mesh(tmp_path / "empty.ply", empty)
    with pytest.raises(SarsplatError, match=r"choose a name that ends in \.ply, \.glb, \.obj, \.stl"):
        write_mesh(tmp_path / "ball.3ds", ball.mesh)
    assert list(tmp_path.iterdir()) == []


def test_the_mesh_does_not_depend_on_its_bricks(ball: Ball, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does a stray far away cost memory: only what is near points is looked at."""
    points, normals = (np.append(ball.points, [[1e5, 1e5, 10.0]], 0), np.append(ball.normals, [[0, 0, 1.0]], 0))
    monkeypatch.setattr("sarsplat.surface.mesh._BRICK", 20)
    mesh = surface_mesh(points, normals, ball.seen, GRID.cell_m)
    assert mesh.is_winding_consistent
    assert mesh.euler_number == ball.mesh.euler_number  # no seam
    assert mesh.area == pytest.approx(ball.mesh.area, rel=1e-5)
    assert len(mesh.faces) == len(ball.mesh.faces)


@pytest.mark.parametrize("missing", ["skimage", "trimesh"])
def test_without_the_extra_it_is_told(ball: Ball, missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == missing]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SarsplatError, match=r"pip install 'sarsplat\[mesh\]'"):
        surface_mesh(ball.points, ball.normals, ball.seen, GRID.cell_m)


# ---- noisy points of known shapes, among Gaussians that are as uncertain ---------------------------------------------
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
        count, (x, y, z) = len(means), axes.T
        turns = torch.tensor(np.column_stack([1 + z, -y, x, 0 * z]))  # of the z axis to the normal: (1 + z, z × n)
        gaussians = upright(means + axes * chance.normal(0, NOISE_M, (count, 1)), [0.08, 0.06, 0.02])
        gaussians = gaussians.with_tensors(quaternions=turns.float())
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
    pytest.importorskip("fcpw")
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


@pytest.mark.parametrize("known", ["barrel"], indirect=True)
def test_the_number_of_threads_changes_no_bit(known: tuple[str, Known], threads: Callable[[int], None]) -> None:
    name, shape = known
    threads(1 if torch.get_num_threads() > 1 else 3)
    again = Known(name)
    assert again.normals.tobytes() == shape.normals.tobytes()
    assert np.asarray(again.mesh.vertices).tobytes() == np.asarray(shape.mesh.vertices).tobytes()
