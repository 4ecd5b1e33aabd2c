"""Images whose phase is known keep it: in memory, on the disk, in parts of a dataset."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from chip_files import phoenix_bytes
from datasets import SIGNALS, TINY, tiny_dataset
from sarsplat.data import Dataset, read_dataset, write_dataset
from sarsplat.importers import import_mstar


def test_the_power_is_that_of_the_signal():
    made = tiny_dataset(SIGNALS, looks=1)
    np.testing.assert_allclose(made.power, np.abs(SIGNALS) ** 2, rtol=1e-6)
    assert (made.power.dtype, made.signal.dtype) == (np.float32, np.complex64)
    np.testing.assert_array_equal(made[1].signal, SIGNALS[1])
    np.testing.assert_array_equal(made.select("train").signal, SIGNALS[[0, 2]])
    np.testing.assert_array_equal(made.take([2, 0]).signal, SIGNALS[[2, 0]])
    assert [entry.name for entry in made.take([2, 0]).entries] == ["002", "000"]


def test_a_folder_keeps_the_phase(tmp_path):
    made = tiny_dataset(SIGNALS, looks=1)
    written = write_dataset(tmp_path / "set", made)
    read = read_dataset(tmp_path / "set")
    np.testing.assert_array_equal(read.signal, SIGNALS)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "set/images/001.tif"), SIGNALS[1])
    assert json.loads((tmp_path / "set/dataset.json").read_text())["pixels"] == "complex"
    assert made.fingerprint() == written.fingerprint() == read.fingerprint()


def test_the_phase_makes_another_dataset():
    made = tiny_dataset(SIGNALS, looks=1)
    turned = Dataset.of_complex(TINY, made.entries, np.conj(SIGNALS), looks=1)
    np.testing.assert_array_equal(turned.power, made.power)
    assert len({made.fingerprint(), turned.fingerprint(), replace(made, signal=None).fingerprint()}) == 3


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
