"""Every export, read back by a program that is not ours."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from made import FEW_POINTS
from made_runs import with_points
from sarsplat import Dataset, Place, SarsplatError, View, load_mesh, preset, read_gaussians_ply
from sarsplat.exports import FORMATS, export, format_of
from sarsplat.runs import Run, reconstruct

laspy = pytest.importorskip("laspy")


@pytest.fixture(scope="module")
def run(small_box: Dataset) -> Run:
    few = replace(preset("quick"), iterations=25, gaussians=600, points=FEW_POINTS)
    return reconstruct(small_box, few, quiet=True)


def test_gaussians_come_back_exactly_whatever_their_colour(run: Run, tmp_path: Path) -> None:
    for colour in ("db", "height"):
        export(run, tmp_path / f"{colour}.ply", colour=colour)
        read = read_gaussians_ply(tmp_path / f"{colour}.ply")
        for name, tensor in run.gaussians.tensors().items():
            assert torch.equal(read.tensors()[name], tensor), name
    assert (tmp_path / "db.ply").read_bytes() != (tmp_path / "height.ply").read_bytes()


@pytest.mark.parametrize("ending", ["glb", "obj", "ply", "stl"])
def test_meshes_are_read_by_trimesh(run: Run, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"mesh.{ending}"
    said = export(run, path, "mesh").summary
    assert said.endswith("stored vertices are z up" if ending == "glb" else "triangles, metres, z up")
    read: Any = trimesh.load(path, force="mesh")  # a scene's nodes applied
    expected = run.mesh()
    assert expected is run.mesh()  # made once for scores, report and exports
    (x0, y0, z0), (x1, y1, z1) = expected.bounds
    upright = [(x0, z0, -y1), (x1, z1, -y0)] if ending == "glb" else expected.bounds  # y is up in glTF
    np.testing.assert_allclose(read.bounds, upright, atol=1e-5)
    np.testing.assert_allclose(load_mesh(path).bounds, expected.bounds, atol=1e-5)
    if ending == "glb":  # what is stored, without the node
        assert "viewers see (x, z, -y) of the scene" in said
        scene: Any = trimesh.load(path)
        (stored,) = scene.geometry.values()
        np.testing.assert_allclose(stored.bounds, expected.bounds, atol=1e-5)
    assert read.area == pytest.approx(expected.area, rel=1e-4)
    assert len(read.faces) == len(expected.faces)


def test_points_are_read_by_trimesh(run: Run, tmp_path: Path) -> None:
    export(run, tmp_path / "points.ply", "points")
    read: Any = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_array_equal(np.float32(read.vertices), run.points)
    values = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(values["gamma0"]), run.points_gamma0)
    np.testing.assert_array_equal(np.ravel(values["nz"]), run.normals[:, 2])


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_is_read_by_laspy(run: Run, tmp_path: Path, ending: str) -> None:
    export(run, tmp_path / f"points.{ending}")
    read = laspy.read(tmp_path / f"points.{ending}")
    assert read.header.are_points_compressed == (ending == "laz")
    assert (str(read.header.version), read.header.point_format.id) == ("1.4", 6)
    np.testing.assert_allclose(read.xyz, run.points, atol=0.5001e-4)  # m
    for name, expected in zip(("nx", "ny", "nz"), run.normals.T, strict=True):
        np.testing.assert_array_equal(read[name], expected)
    np.testing.assert_array_equal(read["gamma0"], run.points_gamma0)
    level_db = 10 * np.log10(run.points_gamma0 / run.points_gamma0.max())
    np.testing.assert_allclose(read.intensity, 65535 * np.clip(1 + level_db / 30, 0, 1), atol=1)
    (frame,) = [record for record in read.header.vlrs if "WktCoordinate" in type(record).__name__]
    assert frame.string.startswith("LOCAL_CS[") and 'UNIT["metre",1]' in frame.string
    assert read.header.global_encoding.wkt


def test_las_holds_targets_of_any_size(run: Run, tmp_path: Path) -> None:
    export(with_points(run, run.points * 1e6, run.normals, None), tmp_path / "large.las")
    np.testing.assert_allclose(laspy.read(tmp_path / "large.las").xyz, run.points * 1e6, atol=1, rtol=1e-6)


def test_splat_holds_what_its_viewer_reads(run: Run, tmp_path: Path) -> None:
    """As antimatter15/splat reads it: six floats, four colours, four bytes of a rotation; the most important first."""
    row = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("turn", "u1", 4)])
    export(run, tmp_path / "all.splat")
    rows, gaussians = np.frombuffer((tmp_path / "all.splat").read_bytes(), row), run.gaussians
    assert len(rows) == len(gaussians)
    means, scales = gaussians.means.numpy(), gaussians.scales.numpy()
    alpha = 1 - np.exp(-gaussians.optical_depth.double().numpy())
    order = np.argsort(-(scales.astype(float).prod(axis=1) * alpha), kind="stable")
    np.testing.assert_array_equal(rows["mean"], means[order])
    np.testing.assert_array_equal(rows["scale"], scales[order])
    np.testing.assert_allclose(rows["colour"][:, 3], 255 * alpha[order], atol=0.51)
    turn = (rows["turn"].astype(float) - 128) / 128
    expected = torch.nn.functional.normalize(gaussians.quaternions, dim=1).numpy()[order]
    np.testing.assert_allclose(turn, expected, atol=1.01 / 128)
    assert rows["colour"][:, :3].std() > 5  # not all the same
    np.testing.assert_array_equal(rows["colour"][:, 0], rows["colour"][:, 2])  # grey
    export(run, tmp_path / "height.splat", colour="height")
    coloured = np.frombuffer((tmp_path / "height.splat").read_bytes(), row)["colour"]
    low, high = (means[order][:, 2].argsort()[k] for k in (0, -1))
    assert coloured[low, 2] > coloured[low, 0]  # blue below
    assert coloured[high, 0] > coloured[high, 2]  # yellow above


def test_errors_on_unknown_endings_list_the_valid_ones(tmp_path: Path) -> None:
    *others, last = (f".{ending}" for ending in FORMATS)
    endings = f"{', '.join(others)} or {last}"
    for name in ("a.3ds", "a", "a.PLYX"):
        with pytest.raises(SarsplatError, match=rf"not a valid name for an export; .* ends in {endings}"):
            format_of(Path(name))
    with pytest.raises(SarsplatError, match=r"not a valid name for gaussians; choose one that ends in \.glb, \.ply or"):
        format_of(Path("a.las"), "gaussians")
    assert format_of(Path("A.PLY"))[1] == "gaussians"


@pytest.mark.parametrize("ending", FORMATS)
def test_empty_runs_are_not_exported(run: Run, tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "gaussians", run.gaussians[:0])
    empty = with_points(run, np.empty((0, 3)), np.empty((0, 3)), None, place=Place(1.0, 2.0, 3.0))
    for content in FORMATS[ending].writers:
        view = View(30, 35) if content == "layover-shadow" else None
        with pytest.raises(SarsplatError, match=r"the run in memory has (no|too few) "):
            export(empty, tmp_path / f"a.{ending}", content, view=view)
    assert list(tmp_path.iterdir()) == []


def test_other_methods_have_points_but_no_gaussians(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "gaussians", None)
    other = with_points(run, np.eye(3), np.eye(3), None, method="sar-nerf-grid")
    for name in ("a.ply", "a.splat"):
        with pytest.raises(SarsplatError, match=r"was made by sar-nerf-grid, which learns no Gaussians; export its"):
            export(other, tmp_path / name)
    export(other, tmp_path / "a.las")


def test_las_without_laspy_says_what_to_install(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(SarsplatError, match=r"pip install 'sarsplat\[las\]'"):
        export(run, tmp_path / "a.las")
    assert list(tmp_path.iterdir()) == []
