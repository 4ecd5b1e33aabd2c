"""The SAMPLE set, on files made after its public description; the set itself was never at hand."""

from __future__ import annotations

import numpy as np
import pytest

from made import write_sample
from sarsplat.cli import main
from sarsplat.data import read_dataset
from sarsplat.errors import SarsplatWarning
from sarsplat.geometry.responses import GAUSSIAN, TAYLOR
from sarsplat.importers import import_sample

RNG = np.random.default_rng(0)
AZIMUTHS = (11.2, 20.1, 44.7, 62.4, 79.3)
IMAGES = (RNG.normal(size=(5, 24, 18)) + 1j * RNG.normal(size=(5, 24, 18))).astype(np.complex64)


@pytest.fixture
def folder(tmp_path):
    for image, azimuth in zip(IMAGES, AZIMUTHS, strict=True):
        write_sample(tmp_path / "set", image, azimuth)
        write_sample(tmp_path / "set", 3 * image, azimuth, kind="synth")
    write_sample(tmp_path / "set", IMAGES[0], 30.0, target="zsu23")
    return tmp_path / "set"


@pytest.mark.filterwarnings("ignore:.*leave a gap")
def test_images_angles_and_lengths(folder, tmp_path):
    made = import_sample(folder, tmp_path / "out", target="T72")
    scale = made.source["mean_power"] ** 0.5
    np.testing.assert_allclose(made.signal * np.float32(scale), IMAGES[:, ::-1, ::-1], rtol=1e-5)
    np.testing.assert_array_equal(read_dataset(tmp_path / "out").signal, made.signal)
    assert [view.azimuth_deg for view in made.views] == pytest.approx([360 - azimuth for azimuth in AZIMUTHS])
    assert {view.grazing_deg for view in made.views} == {15.8}
    assert (made.grid.spacing_m, made.grid.resolution_m) == ((0.2031, 0.2021), (0.3047, 0.3047))
    assert (made.target, made.calibration, made.looks, made.ground) == ("t72", "relative", 1.0, True)
    assert (made.source["taylor_weights"], made.source["bandwidth"]) == (35, 591e6)
    assert made.grid.response == TAYLOR
    assert "the Taylor window has n̄ = 4" in made.source["assumptions"]
    assert made.entries[0].name == "mat_files/real/t72/t72_real_A_elevDeg_016_azCenter_011_77_serial_812.mat"


@pytest.mark.filterwarnings("ignore:.*leave a gap")
def test_synthetic_images_training_views_and_other_orientations(folder, tmp_path):
    options = {"target": "t72", "kind": "synthetic", "near": "top", "mirrored": True, "train_views": 3}
    made = import_sample(folder / "mat_files", tmp_path / "out", **options)
    scale = made.source["mean_power"] ** 0.5
    order = [0, 2, 4, 1, 3]  # the ends and the middle of what the azimuths cover, then the rest
    np.testing.assert_allclose(made.signal * np.float32(scale), 3 * IMAGES[order][:, :, ::-1], rtol=1e-5)
    assert [view.azimuth_deg for view in made.views] == pytest.approx([AZIMUTHS[index] for index in order])
    assert [entry.split for entry in made.entries] == ["train"] * 3 + ["test"] * 2


@pytest.mark.filterwarnings("ignore:.*(leave a gap|one training view)")
def test_what_headers_lack(folder, tmp_path):
    other = tmp_path / "other"
    lacking = {"azimuth": np.radians(20.4), "xrange_pixel_spacing": 0, "taylor_weights": None}
    write_sample(other, IMAGES[0], 20.4, changes=lacking)
    (other / "notes.mat").write_bytes(b"")
    with pytest.warns(SarsplatWarning, match="1 MATLAB file in .* left out"):
        made = import_sample(other, tmp_path / "out", target="t72")
    assert made.views[0].azimuth_deg == pytest.approx(339.6)
    assert made.grid.spacing_m == (0.2021, 0.2021)
    assert "taylor_weights" not in made.source
    assert made.grid.response == GAUSSIAN


@pytest.mark.usefixtures("undrawn")
def test_the_command(folder, tmp_path, capsys):
    words = ["import", "sample", str(folder), "--class", "t72", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "assumed: near range is the bottom row, and the images are not mirrored" in told
    assert "5 views of 3.66 m × 4.85 m, largest gap 292°, ready" in told
