"""Datasets: what is written comes back, in memory as on the disk, and nothing wrong is believed."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from datasets import dataset_of
from sarsplat.data import Dataset, SarImage, read_dataset, read_tiff, write_dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.responses import Taylor

GRID = ImageGrid(6, 5, (0.2, 0.3), (0.25, 0.35), (1.0, -2.0))
VIEWS = [
    (View(0.1, 15.0), "train"),
    (View(-45.0, 30.0), "test-17"),
    (View(400.0, 75.0), "train"),
    (View(90.0, 17.09375), "test"),
]
IMAGES = np.random.default_rng(1).gamma(1.0, size=(4, 6, 5)).astype(np.float32)


def make(path: Path, *, grid=GRID, views=VIEWS, images=IMAGES, truth_mesh=None, overwrite=False, **fields) -> Dataset:
    fields = {"source": {"kind": "made up"}, **fields}
    return write_dataset(path, dataset_of(grid, views, images, **fields), truth_mesh=truth_mesh, overwrite=overwrite)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    return make(tmp_path_factory.mktemp("written") / "set").path


@pytest.fixture
def dataset(tmp_path, written):
    return read_dataset(shutil.copytree(written, tmp_path / "set"))


def test_round_trip(tmp_path):
    fields = {
        "target": "t72",
        "calibration": "relative",
        "looks": 3,
        "clean_tests": True,
        "ground": True,
        "score_margin": 2,
        "target_box_m": ((-1, -2.5, 0), (4, 5, 6)),
        "protocol": "mstar",
        "source": {"kind": "made up", "list": (1, 2.5, None)},
    }
    dataset = make(tmp_path / "set", **fields)
    again = read_dataset(tmp_path / "set")
    for read in (dataset, again):
        assert {name: getattr(read, name) for name in fields} == {**fields, "source": read.source}
        assert (read.path, read.truth_mesh, read.grid) == (tmp_path / "set", None, GRID)
        np.testing.assert_array_equal(read.power, IMAGES)
    assert again.source == {"kind": "made up", "list": [1, 2.5, None]}
    assert again.entries == dataset.entries
    assert again.power.dtype == np.float32


def test_sets_of_a_dataset(dataset):
    assert dataset.splits() == ("train", "test-17", "test")
    assert dataset.views == tuple(view for view, _ in VIEWS)
    train = dataset.select("train")
    assert [view.azimuth_deg for view in train.views] == [0.1, 400.0]
    assert [entry.name for entry in train.entries] == ["000", "002"]
    np.testing.assert_array_equal(train.power, IMAGES[[0, 2]])
    np.testing.assert_array_equal(dataset.images("train"), IMAGES[[0, 2]])
    np.testing.assert_array_equal(dataset.images("test"), IMAGES[3:])
    assert repr(dataset) == "<Dataset of unnamed: 2 train, 1 test-17, 1 test; 6 × 5 pixels>"
    for ask in (dataset.images, dataset.select):
        with pytest.raises(SarsplatError, match="no set 'test-15'; it has train, test-17, test"):
            ask("test-15")


def test_each_set_knows_whether_it_is_speckled(tmp_path):
    dataset = make(tmp_path / "set", looks=4, clean_tests=True)
    assert {split: dataset.select(split).looks for split in dataset.splits()} == {
        "train": 4,
        "test-17": None,
        "test": None,
    }
    assert dataset.speckle == "4 looks, test images without"
    plain = make(tmp_path / "plain", looks=1)
    assert [plain.select(split).looks for split in plain.splits()] == [1, 1, 1]
    assert (plain.speckle, plain.select("test").speckle) == ("1 look", "1 look")
    with pytest.raises(SarsplatError, match="looks is None"):
        make(tmp_path / "neither", clean_tests=True)


def test_a_header_from_before_some_fields_is_the_same_dataset(dataset):
    header = json.loads((dataset.path / "dataset.json").read_text())
    assert header.pop("clean_tests") is False
    assert [view.pop("azimuth_std_deg") for view in header["views"]] == [None] * 4
    (dataset.path / "dataset.json").write_text(json.dumps(header))
    assert read_dataset(dataset.path).fingerprint() == dataset.fingerprint()


def test_a_dataset_is_a_sequence_of_images(dataset):
    assert len(dataset) == len(list(dataset)) == 4
    image = dataset[-1]
    assert (image.view, image.grid) == (VIEWS[3][0], GRID)
    np.testing.assert_array_equal(image.power, IMAGES[3])
    with pytest.raises(IndexError):
        dataset[4]


def test_a_dataset_in_memory_is_the_one_it_becomes_on_the_disk(tmp_path):
    images = [SarImage(power.astype(np.float64), view, GRID) for power, (view, _) in zip(IMAGES, VIEWS)]
    dataset = Dataset.from_images(images[:3], test=images[3:], target="a", looks=1, source={"x": (1, 2)})
    assert [(entry.split, entry.name) for entry in dataset.entries] == [
        *(("train", "000"), ("train", "001"), ("train", "002"), ("test", "003"))
    ]
    assert (dataset.path, str(dataset)) == (None, "the dataset of a in memory")
    written = write_dataset(tmp_path / "set", dataset)
    np.testing.assert_array_equal(read_dataset(tmp_path / "set").power, dataset.power)
    assert dataset.fingerprint() == written.fingerprint() == read_dataset(tmp_path / "set").fingerprint()


def test_azimuths_may_be_uncertain(tmp_path):
    images = [SarImage(power, view, GRID) for power, (view, _) in zip(IMAGES, VIEWS)]
    known, alike, each = (
        Dataset.from_images(images[:3], test=images[3:], azimuth_std_deg=std)
        for std in (0, 2, [0, 1.5, np.float32(2), 0])
    )
    assert [entry.azimuth_std_deg for entry in alike.entries] == [2.0] * 4
    written = write_dataset(tmp_path / "set", each)
    read = read_dataset(tmp_path / "set")
    assert [entry.azimuth_std_deg for entry in read.entries] == [0, 1.5, 2.0, 0]
    assert len({known.fingerprint(), alike.fingerprint(), each.fingerprint()}) == 3
    assert written.fingerprint() == read.fingerprint()
    with pytest.raises(SarsplatError, match="azimuth_std_deg holds 2 numbers for 4 images"):
        Dataset.from_images(images, azimuth_std_deg=[1, 2])
    for wrong in (-1, 11, float("nan")):
        with pytest.raises(SarsplatError, match="is not a number between 0 and 10"):
            Dataset.from_images(images, azimuth_std_deg=[wrong] * 4)


def test_images_of_two_grids_are_no_dataset():
    one, other = (SarImage(IMAGES[0], VIEWS[0][0], grid) for grid in (GRID, replace(GRID, center_m=(0, 0))))
    with pytest.raises(SarsplatError, match=r"image 1 is on .* but the first image is on"):
        Dataset.from_images([one, other])
    with pytest.raises(SarsplatError, match="no training images"):
        Dataset.from_images([], test=[one])


def test_each_image_is_read_once(dataset, monkeypatch):
    opened = []
    monkeypatch.setattr(
        "sarsplat.data.dataset_folder.read_tiff",
        lambda path, *expected: opened.append(path.name) or read_tiff(path, *expected),
    )
    again = read_dataset(dataset.path)
    again.images("train"), again.fingerprint(), again.select("test").power, again[0]
    assert opened == ["000.tif", "001.tif", "002.tif", "003.tif"]


def test_tiffs_say_what_they_are(dataset):
    with tifffile.TiffFile(dataset.path / "images" / "001.tif") as tiff:
        assert "beta0 in linear power" in tiff.pages.first.description
        assert "azimuth -45 deg, grazing 30 deg" in tiff.pages.first.description


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 7), (7, 1)])
def test_thin_images(tmp_path, rows, columns):
    images = np.ones((1, rows, columns), np.float32)
    grid = ImageGrid(rows, columns, (1, 1), (1, 1))
    made = make(tmp_path / "set", grid=grid, views=VIEWS[:1], images=images)
    np.testing.assert_array_equal(made.images("train"), images)


def test_fingerprint_follows_header_and_pixels_not_place(dataset, tmp_path):
    first = dataset.fingerprint()
    shutil.copytree(dataset.path, tmp_path / "copy")
    assert read_dataset(tmp_path / "copy").fingerprint() == first
    touched = IMAGES.copy()
    touched[3, 5, 4] *= 1.0001
    assert make(tmp_path / "a", images=touched).fingerprint() != first
    assert make(tmp_path / "b", source={"kind": "other"}).fingerprint() != first
    assert make(tmp_path / "c", looks=1).fingerprint() != first


def test_a_response_is_kept_and_may_be_absent(dataset, tmp_path):
    header = json.loads((dataset.path / "dataset.json").read_text())
    assert header["grid"].pop("response") is None  # as in files from before there were responses
    (dataset.path / "dataset.json").write_text(json.dumps(header))
    assert read_dataset(dataset.path).fingerprint() == dataset.fingerprint()
    made = make(tmp_path / "other", grid=replace(GRID, response=Taylor(40, 5)))
    header = json.loads((made.path / "dataset.json").read_text())
    assert header["grid"]["response"] == {"kind": "taylor", "level_db": 40.0, "sidelobes": 5}
    assert read_dataset(made.path).grid == made.grid
    assert read_dataset(made.path).fingerprint() == made.fingerprint() != dataset.fingerprint()
    header["grid"]["response"]["level_db"] = "loud"
    (made.path / "dataset.json").write_text(json.dumps(header))
    with pytest.raises(SarsplatError, match=r"dataset\.json: a Taylor response of level_db 'loud'"):
        read_dataset(made.path)


def test_truth_mesh(tmp_path):
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    dataset = make(tmp_path / "set", truth_mesh=box)
    assert dataset.truth_mesh == tmp_path / "set" / "truth.ply"
    assert trimesh.load_mesh(dataset.truth_mesh).volume == pytest.approx(6.0)
    copied = write_dataset(tmp_path / "copy", dataset)
    assert copied.truth_mesh.read_bytes() == dataset.truth_mesh.read_bytes()
    dataset.truth_mesh.unlink()
    with pytest.raises(SarsplatError, match=r"is missing its mesh 'truth\.ply'"):
        read_dataset(dataset.path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"images": IMAGES[:3]}, "of shape"),
        ({"images": IMAGES.astype(np.float64)}, "float64"),
        ({"images": np.where(IMAGES[2, 3, 4] == IMAGES, np.nan, IMAGES)}, r"image '002' holds nan at \(3, 4\)"),
        ({"images": -IMAGES}, "finite and ≥ 0"),
        ({"views": [(v, "test") for v, _ in VIEWS]}, "nothing to train on"),
        ({"views": [(v, "validation") for v, _ in VIEWS]}, "'validation'"),
        ({"source": {"x": float("nan")}}, "JSON"),
        ({"source": ["x"]}, "source"),
        ({"source": {"x": object()}}, "JSON"),
        ({"calibration": "dreamt"}, "'dreamt'"),
        ({"looks": 0}, "looks 0 must be a positive number"),
        ({"looks": "one"}, "looks"),
        ({"score_margin": 3}, "score_margin 3 does not suit images of 6 × 5 pixels"),
        ({"score_margin": -1}, "score_margin -1"),
        ({"target_box_m": ((0, 0, 0), (1, 1, 0))}, "target_box_m"),
        ({"target_box_m": ((0, 0), (1, 1))}, "target_box_m"),
    ],
)
def test_wrong_input_writes_nothing(tmp_path, changes, words):
    with pytest.raises(SarsplatError, match=words):
        make(tmp_path / "set", **changes)
    assert list(tmp_path.iterdir()) == []


def test_overwrite(dataset):
    with pytest.raises(SarsplatError, match="overwrite=True"):
        make(dataset.path)
    make(dataset.path, images=IMAGES * 2, overwrite=True)
    np.testing.assert_array_equal(read_dataset(dataset.path).power, IMAGES * 2)
    np.testing.assert_array_equal(dataset.power, IMAGES)


def test_missing_empty_and_other_folders(tmp_path, dataset):
    with pytest.raises(SarsplatError, match=r"does not exist; make one with `sarsplat simulate`"):
        read_dataset(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SarsplatError, match="is empty"):
        read_dataset(tmp_path / "empty")
    with pytest.raises(SarsplatError, match="give the folder"):
        read_dataset(dataset.path / "dataset.json")
    with pytest.raises(SarsplatError, match=r"not a dataset, .* no dataset\.json; `sarsplat info .*` says"):
        read_dataset(dataset.path / "images")
    (tmp_path / "empty" / "metrics.jsonl").write_text("")
    with pytest.raises(SarsplatError, match="looks like a run"):
        read_dataset(tmp_path / "empty")


def change(header: dict, place: str, value: object) -> None:
    *parents, last = [int(key) if key.isdigit() else key for key in place.split(".")]
    for key in parents:
        header = header[key]
    if value is KeyError:
        del header[last]
    else:
        header[last] = value


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("schema", "other", "its schema is 'other', not 'sarsplat-dataset'"),
        ("schema_version", 1, "its schema_version is 1 but this program reads 2; simulate or import it again"),
        ("quantity", "sigma0", "quantity is 'sigma0'"),
        ("unit", "decibels", "unit"),
        ("calibration", None, "calibration"),
        ("looks", -1.0, "looks -1.0"),
        ("looks", True, "looks is True"),
        ("ground", 1, "ground is 1: expected `bool`"),
        ("score_margin", 1.5, "score_margin is 1.5"),
        ("target_box_m", [[0, 0, 0]], "target_box_m"),
        ("protocol", 3, "protocol is 3"),
        ("domain", "rendered", "unknown field `domain`"),
        ("grid", [], r"grid is \[\]: expected `object`"),
        ("grid.rows", 6.0, "grid.rows is 6.0: expected `int`, got `float`"),
        ("grid.rows", True, "grid.rows"),
        ("grid.rows", -1, "empty"),
        ("grid.rows", 7, "shape|too few"),
        ("grid.rows", 10**9, "too large"),
        ("grid.rows", 5, "shape"),
        ("grid.spacing_m", [0.1], "grid.spacing_m is .* length 2"),
        ("grid.spacing_m", [0.1, 0], "positive"),
        ("grid.center_m", [0, 10**400], r"grid.center_m\[1\] is 1000.*: number out of range"),
        ("grid.resolution_m", KeyError, "grid: object missing required field `resolution_m`"),
        ("grid.tilt", 1, "grid: object contains unknown field `tilt`"),
        ("grid.\x1b[2J", 1, "unknown field `.\\[2J`"),
        ("source", "somewhere", "source is 'somewhere'"),
        ("truth_mesh", 3, "truth_mesh"),
        ("truth_mesh", "../x.ply", "is not inside"),
        ("views", {}, "views: expected `array`"),
        ("views", [], "a dataset needs images"),
        ("views.0", 7, r"views\[0\] is 7: expected `object`"),
        ("views.1.grazing_deg", 90, r"views\[1\]: grazing angle 90"),
        ("views.1.azimuth_deg", "north", r"views\[1\].azimuth_deg is 'north': expected `float`, got `str`"),
        ("views.1.name", None, "name"),
        ("views.1.azimuth_std_deg", -1, "azimuth_std_deg -1.0 of the image '001' is not a number between 0 and 10"),
        ("views.1.azimuth_std_deg", "1", r"views\[1\].azimuth_std_deg is '1'"),
        ("views.1.split", "TEST", "split"),
        ("views.1.file", "../images/001.tif", "is not inside"),
        ("views.1.file", "/etc/passwd", "is not inside"),
        ("views.1.file", "images/a\0b.tif", "is not inside"),
        ("views.1.file", "", "is not inside"),
        ("views.1.file", "images/\x1b[2J.tif", "is not inside"),
        ("views.1.file", "images/000.tif", "same image"),
        ("views.1.file", "images/none.tif", "does not exist"),
        ("views.1.file", "images", "is a folder"),
    ],
)
def test_wrong_headers(dataset, place, value, words):
    path = dataset.path / "dataset.json"
    header = json.loads(path.read_text())
    change(header, place, value)
    path.write_text(json.dumps(header))
    with pytest.raises(SarsplatError, match=words):
        read_dataset(dataset.path)


def test_links_out_of_the_folder_are_refused(dataset, tmp_path):
    image = dataset.path / "images" / "000.tif"
    image.rename(tmp_path / "elsewhere.tif")
    image.symlink_to(tmp_path / "elsewhere.tif")
    with pytest.raises(SarsplatError, match="is not inside"):
        read_dataset(dataset.path)


@pytest.mark.parametrize(
    ("image", "options", "words"),
    [
        (IMAGES[0].astype(np.float64), {}, "float64"),
        (IMAGES[0].T, {}, "shape"),
        (-IMAGES[0], {}, "finite and ≥ 0"),
        (IMAGES[0] * np.float32(np.inf), {}, "finite and ≥ 0"),
        (IMAGES[0], {"compression": "zlib", "description": "x" * 200}, "compress"),
    ],
)
def test_wrong_images(dataset, image, options, words):
    tifffile.imwrite(dataset.path / "images" / "002.tif", image, **options)
    with pytest.raises(SarsplatError, match=words):
        read_dataset(dataset.path)


def test_a_mesh_name_longer_than_names_can_be(dataset):
    header = json.loads((dataset.path / "dataset.json").read_text())
    header["truth_mesh"] = "x" * 300
    (dataset.path / "dataset.json").write_text(json.dumps(header))
    with pytest.raises(SarsplatError, match=r"cannot read .*name is too long"):
        read_dataset(dataset.path)


def test_a_tiff_of_a_thousand_dimensions_is_told_briefly(dataset):
    path = dataset.path / "images" / "001.tif"
    tifffile.imwrite(path, np.zeros((1,) * 20 + (2, 3), np.float32), photometric="minisblack", volumetric=False)
    with pytest.raises(SarsplatError, match="holds float32 pixels of shape") as refusal:
        read_dataset(dataset.path)
    assert len(str(refusal.value)) < 500
