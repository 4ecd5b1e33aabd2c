"""Datasets: what is written comes back, in memory as on the disk, and nothing wrong is believed."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from chip_files import write_originals
from made import NOISE, SIGNALS, TINY, VIEWS, tiny_dataset
from refusals import edit_json
from sarsplat.data import Dataset, SarImage, read_dataset, write_dataset
from sarsplat.geometry import ImageGrid, Turn
from sarsplat.geometry.responses import Taylor
from sarsplat.importers import import_mstar

IMAGES = [SarImage(power.astype(np.float64), view, TINY) for power, (view, _) in zip(NOISE, VIEWS)]


def make(path: Path, **fields) -> Dataset:
    return write_dataset(path, tiny_dataset(**fields))


@pytest.fixture
def dataset(tmp_path):
    return read_dataset(make(tmp_path / "set").path)


def test_round_trip(tmp_path):
    fields = {"target": "t72", "calibration": "relative", "looks": 3, "clean_tests": True, "ground": True}
    fields |= {"score_margin": 2, "target_box_m": ((-1, -2.5, 0), (4, 5, 6)), "protocol": "mstar"}
    fields |= {"source": {"kind": "made up", "list": (1, 2.5, None)}}
    dataset = make(tmp_path / "set", **fields)
    again = read_dataset(tmp_path / "set")
    for read in (dataset, again):
        assert {name: getattr(read, name) for name in fields} == {**fields, "source": read.source}
        assert (read.path, read.truth_mesh, read.grid) == (tmp_path / "set", None, TINY)
        np.testing.assert_array_equal(read.power, NOISE)
    assert again.source == {"kind": "made up", "list": [1, 2.5, None]}
    assert again.entries == dataset.entries
    assert again.power.dtype == np.float32


OLDER = {"views.0.apart_deg": 0.0, "views.0.apart_towards_deg": 0.0}
OLDER |= dict.fromkeys(("grid.response", "clean_tests", "views.3.azimuth_std_deg"), KeyError)


@pytest.mark.parametrize(("place", "value"), OLDER.items())
def test_headers_of_older_versions_are_the_same_dataset(dataset, place, value):
    edit_json(dataset.path / "dataset.json", place, value)
    assert read_dataset(dataset.path).fingerprint() == dataset.fingerprint()


def test_sets_of_a_dataset(dataset):
    assert dataset.splits() == ("train", "test-17", "test")
    assert dataset.views == tuple(view for view, _ in VIEWS)
    train = dataset.select("train")
    assert [view.azimuth_deg for view in train.views] == [0.1, 400.0]
    assert [entry.name for entry in train.entries] == ["000", "002"]
    np.testing.assert_array_equal(train.power, NOISE[[0, 2]])
    np.testing.assert_array_equal(dataset.images("train"), NOISE[[0, 2]])
    np.testing.assert_array_equal(dataset.images("test"), NOISE[3:])
    assert repr(dataset) == "<Dataset of unnamed: 2 train, 1 test-17, 1 test; 6 × 5 pixels>"
    with tifffile.TiffFile(dataset.path / "images" / "001.tif") as tiff:  # which says what it is
        assert "beta0 in linear power" in tiff.pages.first.description
        assert "azimuth -45 deg, grazing 30 deg" in tiff.pages.first.description


def test_each_set_knows_whether_it_is_speckled(tmp_path):
    dataset = make(tmp_path / "set", looks=4, clean_tests=True)
    assert [dataset.select(split).looks for split in ("train", "test-17", "test")] == [4, None, None]
    assert dataset.speckle == "4 looks, test images without"
    plain = make(tmp_path / "plain", looks=1)
    assert [plain.select(split).looks for split in plain.splits()] == [1, 1, 1]
    assert (plain.speckle, plain.select("test").speckle) == ("1 look", "1 look")


def test_a_dataset_is_a_sequence_of_images(dataset):
    assert len(dataset) == len(list(dataset)) == 4
    image = dataset[-1]
    assert (image.view, image.grid) == (VIEWS[3][0], TINY)
    np.testing.assert_array_equal(image.power, NOISE[3])
    with pytest.raises(IndexError):
        dataset[4]


def test_a_dataset_in_memory_is_the_one_it_becomes_on_the_disk(tmp_path):
    dataset = Dataset.from_images(IMAGES[:3], test=IMAGES[3:], target="a", looks=1, source={"x": (1, 2)})
    assert [(entry.split, entry.name) for entry in dataset.entries] == [
        *(("train", "000"), ("train", "001"), ("train", "002"), ("test", "003"))
    ]
    assert (dataset.path, str(dataset)) == (None, "the dataset of a in memory")
    written = write_dataset(tmp_path / "set", dataset)
    np.testing.assert_array_equal(read_dataset(tmp_path / "set").power, dataset.power)
    assert dataset.fingerprint() == written.fingerprint() == read_dataset(tmp_path / "set").fingerprint()


def test_azimuths_may_be_uncertain(tmp_path):
    known, alike, each = (
        Dataset.from_images(IMAGES[:3], test=IMAGES[3:], azimuth_std_deg=std)
        for std in (0, 2, [0, 1.5, np.float32(2), 0])
    )
    assert [entry.azimuth_std_deg for entry in alike.entries] == [2.0] * 4
    written = write_dataset(tmp_path / "set", each)
    read = read_dataset(tmp_path / "set")
    assert [entry.azimuth_std_deg for entry in read.entries] == [0, 1.5, 2.0, 0]
    assert len({known.fingerprint(), alike.fingerprint(), each.fingerprint()}) == 3
    assert written.fingerprint() == read.fingerprint()


def test_rotations_are_kept_with_how_well_they_are_known(tmp_path):
    axis, sight = (0.1, -0.2, 1.0), (1.0, 0.5, 0.3)
    turns = [Turn(axis, 30.0 * k, *((3, np.float32(0.03)) if k else ()), name=f"pass {k // 2}") for k in range(4)]
    views = [turn.seen_from(sight) for turn in turns]
    views[3] = replace(views[3], stretch=1.02)
    images = [SarImage(power, view, TINY) for power, view in zip(NOISE, views)]
    plain, turning = (Dataset.from_images(images[:3], test=images[3:], turns=given) for given in (None, turns))
    written = write_dataset(tmp_path / "set", turning)
    read = read_dataset(tmp_path / "set")
    assert [entry.turn for entry in read.entries] == turns
    assert read.views == turning.views and read.views[3].stretch == 1.02
    assert written.fingerprint() == read.fingerprint() != plain.fingerprint()


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 7), (7, 1)])
def test_thin_images(tmp_path, rows, columns):
    images = np.ones((1, rows, columns), np.float32)
    grid = ImageGrid(rows, columns, (1, 1), (1, 1))
    made = make(tmp_path / "set", grid=grid, views=VIEWS[:1], images=images)
    np.testing.assert_array_equal(read_dataset(made.path).power, images)


def test_fingerprint_follows_header_and_pixels_not_place(dataset, tmp_path):
    first = dataset.fingerprint()
    shutil.copytree(dataset.path, tmp_path / "copy")
    assert read_dataset(tmp_path / "copy").fingerprint() == first
    touched = NOISE.copy()
    touched[3, 5, 4] *= 1.0001
    assert make(tmp_path / "a", images=touched).fingerprint() != first
    assert make(tmp_path / "b", source={"kind": "other"}).fingerprint() != first
    assert make(tmp_path / "c", looks=1).fingerprint() != first


def test_a_response_is_kept(dataset, tmp_path):
    made = make(tmp_path / "other", grid=replace(TINY, response=Taylor(40, 5)))
    header = json.loads((made.path / "dataset.json").read_text())
    assert header["grid"]["response"] == {"kind": "taylor", "level_db": 40.0, "sidelobes": 5}
    assert read_dataset(made.path).grid == made.grid
    assert read_dataset(made.path).fingerprint() == made.fingerprint() != dataset.fingerprint()


def test_truth_mesh(tmp_path):
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    dataset = write_dataset(tmp_path / "set", tiny_dataset(), truth_mesh=box)
    assert dataset.truth_mesh == tmp_path / "set" / "truth.ply"
    assert trimesh.load_mesh(dataset.truth_mesh).volume == pytest.approx(6.0)
    copied = write_dataset(tmp_path / "copy", dataset)
    assert copied.truth_mesh.read_bytes() == dataset.truth_mesh.read_bytes()


def test_signals_have_power_and_phase_in_memory_as_on_the_disk(tmp_path):
    made = tiny_dataset(SIGNALS, looks=1)
    np.testing.assert_allclose(made.power, np.abs(SIGNALS) ** 2, rtol=1e-6)
    assert (made.power.dtype, made.signal.dtype) == (np.float32, np.complex64)
    np.testing.assert_array_equal(made[1].signal, SIGNALS[1])
    np.testing.assert_array_equal(made.select("train").signal, SIGNALS[[0, 2]])
    np.testing.assert_array_equal(made.take([2, 0]).signal, SIGNALS[[2, 0]])
    assert [entry.name for entry in made.take([2, 0]).entries] == ["002", "000"]
    written = write_dataset(tmp_path / "set", made)
    read = read_dataset(tmp_path / "set")
    np.testing.assert_array_equal(read.signal, SIGNALS)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "set/images/001.tif"), SIGNALS[1])
    assert json.loads((tmp_path / "set/dataset.json").read_text())["pixels"] == "complex"
    assert made.fingerprint() == written.fingerprint() == read.fingerprint()
    turned = Dataset.of_complex(TINY, made.entries, np.conj(SIGNALS), looks=1)
    np.testing.assert_array_equal(turned.power, made.power)
    assert len({made.fingerprint(), turned.fingerprint(), replace(made, signal=None).fingerprint()}) == 3


def test_phoenix_files_keep_their_phases(tmp_path):
    chips = write_originals(tmp_path / "chips")
    made = import_mstar(chips, tmp_path / "set", labels=None, target_class="T72", train_views=5)
    np.testing.assert_allclose(np.angle(made.signal[made.power > 0]), 3.0, atol=1e-5)
    assert made.power[:, :8, 8:].min() > 1 > made.power[:, 8:].max()  # turned by 180°
    assert made.power.mean() == pytest.approx(1, rel=1e-5)
