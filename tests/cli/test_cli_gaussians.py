"""Files of Gaussians of other programs in the commands, with what is wrong in them."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from made import dataset_of, upright
from sarsplat.cli import main
from sarsplat.data import read_points_ply, write_dataset, write_gaussians_ply
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, View

COUNT = 60


def scene() -> Gaussians:
    places = np.random.default_rng(0).uniform(-1, 1, (COUNT, 3)) * (2, 1, 0.5) + (0, 0, 0.5)
    return upright(torch.from_numpy(places).float(), 0.2, 2.0, Harmonics(torch.ones(COUNT, 1)))


def rendered(path: Path, *words: str) -> np.ndarray:
    out = path.with_suffix(".tif")
    command = ["render", str(path), "--azimuth", "30", "--grazing", "40", "--out", str(out), "--overwrite", *words]
    assert main(command) == 0
    return tifffile.imread(out)


@pytest.mark.parametrize("stray", ["far", "huge"])
def test_a_stray_gaussian_neither_sets_the_pixels_nor_goes_unsaid(tmp_path, stray, capsys):
    whole = scene()
    means, scales = whole.means.clone(), whole.scales.clone()
    if stray == "far":
        means[-1] = torch.tensor([1e4, 0, 0])
    else:
        scales[-1] = torch.e**30
    write_gaussians_ply(tmp_path / "a.ply", whole.with_tensors(means=means, scales=scales))
    write_gaussians_ply(tmp_path / "b.ply", whole[:-1])
    image = rendered(tmp_path / "a.ply")
    said = capsys.readouterr().err
    assert "1 of 60 Gaussians lies apart or is far larger than all others: up to " in said
    assert "% of the power without shadows; they are left out" in said
    np.testing.assert_array_equal(image, rendered(tmp_path / "b.ply"))
    assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "points.ply"), "--format", "points"]) == 0
    assert np.abs(read_points_ply(tmp_path / "points.ply")[0]).max() < 5
    if stray == "far":  # Gaussians are exported as they are
        assert main(["export", str(tmp_path / "a.ply"), str(tmp_path / "all.ply")]) == 0
        assert b"element vertex 60\n" in (tmp_path / "all.ply").read_bytes()
    assert main(["info", str(tmp_path / "a.ply")]) == 0
    assert "apart          1 of 60 Gaussians" in capsys.readouterr().out


def test_whoever_gives_pixels_and_spacing_sees_what_lies_apart(tmp_path):
    whole = scene()
    means = whole.means.clone()
    means[-1] = torch.tensor([100.0, 0, 0])
    write_gaussians_ply(tmp_path / "a.ply", whole.with_tensors(means=means))
    image = rendered(tmp_path / "a.ply", "--pixels", "256", "256", "--spacing", "1", "--resolution", "1")
    rows, columns = np.nonzero(image > 1e-3 * image.max())
    assert np.hypot(rows - 127.5, columns - 127.5).max() > 60


def test_far_scenes_are_brought_back_whatever_lies_at_the_origin(tmp_path, said):
    whole = scene()
    means = whole.means + torch.tensor([1e4, 2e4, 300])
    means[-1] = 0
    write_gaussians_ply(tmp_path / "a.ply", whole.with_tensors(means=means))
    write_gaussians_ply(tmp_path / "b.ply", whole[:-1])
    image, near = rendered(tmp_path / "a.ply"), rendered(tmp_path / "b.ply")
    assert image.sum() == pytest.approx(near.sum(), rel=0.05)
    told = said(f"info {tmp_path}/a.ply")
    assert "far from the origin; images are made after (" in told


def test_splat_files_are_described_rendered_and_exported(tmp_path, said):
    write_gaussians_ply(tmp_path / "a.ply", scene())
    said(f"export {tmp_path}/a.ply {tmp_path}/a.splat")
    assert "60 Gaussians" in said(f"info {tmp_path}/a.splat")
    assert rendered(tmp_path / "a.splat").max() > 0
    said(f"export {tmp_path}/a.splat {tmp_path}/back.ply")
    assert "60 Gaussians" in said(f"info {tmp_path}/back.ply")


def test_a_mesh_of_sparse_gaussians_is_not_told_to_train_longer(tmp_path, refused):
    thin = scene().with_tensors(optical_depth=torch.full((COUNT,), 0.01))
    write_gaussians_ply(tmp_path / "a.ply", thin)
    told = refused(f"export {tmp_path}/a.ply {tmp_path}/a.glb")
    assert "train" not in told and "export the Gaussians themselves" in told


def test_gaussians_alone_are_not_scored_on_ground_without_a_word(tmp_path, capsys):
    """Nothing scatters where they are not, so speckled ground is impossible to them: that was a dash in the table."""
    grid = ImageGrid(16, 16, (0.3, 0.3), (0.3, 0.3))
    power = np.random.default_rng(0).exponential(size=(8, 16, 16)).astype(np.float32)
    views = [(View(45.0 * k, 40.0), "test" if k % 4 == 0 else "train") for k in range(8)]
    write_dataset(tmp_path / "field", dataset_of(grid, views, power, ground=True, looks=1))
    write_gaussians_ply(tmp_path / "g.ply", scene())
    assert main(["evaluate", str(tmp_path / "g.ply"), "--dataset", str(tmp_path / "field"), "--no-points"]) == 0
    assert "evaluate the run that it was exported from" in " ".join(capsys.readouterr().err.split())
