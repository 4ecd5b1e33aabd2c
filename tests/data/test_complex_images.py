"""Images whose phase is known keep it: in memory, on the disk, in parts of a dataset."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from chip_files import phoenix_bytes
from sarsplat.data import Dataset, SarImage, read_dataset, write_dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.importers import import_mstar

GRID = ImageGrid(6, 5, (0.2, 0.3), (0.25, 0.35))
VIEWS = [View(azimuth, 30.0) for azimuth in (0.0, 120.0, 240.0)]
_RNG = np.random.default_rng(2)
SIGNAL = (_RNG.normal(size=(3, 6, 5)) + 1j * _RNG.normal(size=(3, 6, 5))).astype(np.complex64)


def dataset() -> Dataset:
    images = [SarImage.of_complex(signal, view, GRID) for signal, view in zip(SIGNAL, VIEWS)]
    return Dataset.from_images(images[:2], test=images[2:], looks=1)


def test_the_power_is_that_of_the_signal():
    made = dataset()
    np.testing.assert_allclose(made.power, np.abs(SIGNAL) ** 2, rtol=1e-6)
    assert (made.power.dtype, made.signal.dtype) == (np.float32, np.complex64)
    np.testing.assert_array_equal(made[1].signal, SIGNAL[1])
    np.testing.assert_array_equal(made.select("test").signal, SIGNAL[2:])
    np.testing.assert_array_equal(made.take([2, 0]).signal, SIGNAL[[2, 0]])
    assert [entry.name for entry in made.take([2, 0]).entries] == ["002", "000"]


def test_a_folder_keeps_the_phase(tmp_path):
    made = dataset()
    written = write_dataset(tmp_path / "set", made)
    read = read_dataset(tmp_path / "set")
    np.testing.assert_array_equal(read.signal, SIGNAL)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "set/images/001.tif"), SIGNAL[1])
    assert json.loads((tmp_path / "set/dataset.json").read_text())["pixels"] == "complex"
    assert made.fingerprint() == written.fingerprint() == read.fingerprint()


def test_the_phase_makes_another_dataset():
    made = dataset()
    turned = Dataset.of_complex(GRID, made.entries, np.conj(SIGNAL), looks=1)
    np.testing.assert_array_equal(turned.power, made.power)
    assert len({made.fingerprint(), turned.fingerprint(), replace(made, signal=None).fingerprint()}) == 3


def test_what_does_not_fit_together_is_refused(tmp_path):
    made = dataset()
    with pytest.raises(SarsplatError, match="not the squared magnitude of its signal"):
        replace(made, power=2 * made.power)
    with pytest.raises(SarsplatError, match="not the squared magnitude of its signal"):
        SarImage(made.power[0], VIEWS[0], GRID, SIGNAL[1])
    with pytest.raises(SarsplatError, match="of type float64; give an array of complex amplitudes"):
        SarImage.of_complex(np.ones((6, 5)), VIEWS[0], GRID)
    with pytest.raises(SarsplatError, match=r"holds inf at \(0, 0\)"):
        SarImage.of_complex(np.full((6, 5), 1e30 + 0j), VIEWS[0], GRID)
    with pytest.raises(SarsplatError, match=r"holds nan at \(0, 0\)"):
        SarImage.of_complex(np.full((6, 5), np.nan + 0j), VIEWS[0], GRID)
    with pytest.raises(SarsplatError, match="2 of 3 images have their phase"):
        Dataset.from_images([*(made[k] for k in range(2)), SarImage(made.power[2], VIEWS[2], GRID)])
    with pytest.raises(SarsplatError, match="a dataset needs images"):
        Dataset.of_complex(GRID, (), np.empty((0, 6, 5), np.complex64))


def test_a_folder_that_names_the_other_kind_of_pixels_is_refused(tmp_path):
    write_dataset(tmp_path / "set", dataset())
    header = tmp_path / "set/dataset.json"
    header.write_text(header.read_text().replace('"complex"', '"power"'))
    with pytest.raises(SarsplatError, match="holds complex64 pixels"):
        read_dataset(tmp_path / "set")


def test_phoenix_files_keep_their_phases(tmp_path):
    (tmp_path / "chips").mkdir()
    magnitude = (1 + np.arange(24, dtype=np.float32)).reshape(4, 6)
    for index in range(3):
        (tmp_path / f"chips/HB{index}.015").write_bytes(
            phoenix_bytes(magnitude * (1 + index), TargetAz=str(120 * index))
        )
    made = import_mstar(tmp_path / "chips", tmp_path / "set", labels=None, target_class="T72", train_views=3)
    np.testing.assert_allclose(np.angle(made.signal), 3.0, atol=1e-5)
    np.testing.assert_allclose(np.sqrt(made.power[0] / made.power[0, -1, -1]), magnitude[::-1, ::-1], rtol=1e-5)
    assert made.power.mean() == pytest.approx(1, rel=1e-5)
