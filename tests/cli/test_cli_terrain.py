"""Terrain from a GeoTIFF to a reconstruction, on the command line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sarsplat import Run, read_dataset
from sarsplat.cli import main
from terrains import terrain, write_geotiff

SIMULATE = "simulate --target slicy --pixels 32 --spacing 0.3 --ray-spacing 0.15 --azimuth 0:360:60 --grazing 40 60"


@pytest.fixture
def geotiff(tmp_path):
    """An oblong slope with a bump, on a hill of 400 m."""
    relief = terrain(lambda x, y: 400 + 0.15 * x + np.exp(-((x - 3) ** 2) - y**2), (12.0, 9.0), (0.75, 0.5))
    return write_geotiff(tmp_path / "dem.tif", relief.heights_m[::-1].astype(np.float32), scale=(0.75, 0.5, 0.0))


def test_from_heights_to_a_reconstruction(tmp_path, geotiff, capsys):
    data, run = tmp_path / "data", tmp_path / "run"
    assert main([*SIMULATE.split(), "--ground", "0.04", "--terrain", str(geotiff), "--out", str(data)]) == 0
    dataset = read_dataset(data)
    assert dataset.terrain.heights_m.shape == (37, 33)
    assert dataset.terrain.height_m(np.zeros(1), np.zeros(1)) == pytest.approx(0.0, abs=1e-6)
    assert main(["info", str(data)]) == 0
    assert "24 × 18 m (x × y)" in capsys.readouterr().out
    words = ["--preset", "quick", "--iterations", "20", "--points.voxel", "0.3", "--points.rays-per-pixel", "2"]
    assert main(["reconstruct", str(data), *words, "--out", str(run)]) == 0
    loaded = Run.load(run)
    kept: Any = loaded.model.ground().height_m
    assert np.array_equal(kept.heights_m, dataset.terrain.heights_m)
    assert (
        loaded.gaussians.means[:, 2].numpy() >= kept.height_m(*loaded.gaussians.means[:, :2].numpy().T) - 1e-5
    ).all()
    rendered = loaded.render(dataset.views)
    assert np.abs(rendered - dataset.power).mean() < 0.5 * dataset.power.mean()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--terrain", "{tif}"], "has no γ⁰; give that too, with --ground"),
        (["--ground", "0.1", "--terrain", "{tif}", "--masks"], "--masks are of a target on flat ground; leave out"),
        (["--ground", "0.1", "--terrain", "missing.tif"], "missing.tif"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(tmp_path, geotiff, capsys, words, message):
    words = [word.replace("{tif}", str(geotiff)) for word in words]
    assert main([*SIMULATE.split(), *words, "--out", str(tmp_path / "data")]) == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "data").exists()
