"""Datasets: what is written comes back, and nothing wrong is believed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from sarsplat.data import Dataset, read_dataset, read_power_tiff, write_dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(6, 5, (0.2, 0.3), (0.25, 0.35), (1.0, -2.0))
VIEWS = [
    (View(0.1, 15.0), "train", None),
    (View(-45.0, 30.0), "test-17", 45.5),
    (View(400.0, 75.0), "train", None),
    (View(90.0, 17.09375), "test", 270.0),
]
IMAGES = np.random.default_rng(1).gamma(1.0, size=(4, 6, 5)).astype(np.float32)


def make(path: Path, **changes) -> Dataset:
    arguments = {"grid": GRID, "views": VIEWS, "images": IMAGES, "source": {"kind": "made up"}, "domain": "rendered"}
    return write_dataset(path, **{**arguments, **changes})


@pytest.fixture
def dataset(tmp_path):
    return make(tmp_path / "set")


def test_round_trip(dataset):
    again = read_dataset(dataset.path)
    assert again == dataset
    assert again.grid == GRID
    assert again.source == {"kind": "made up"}
    assert again.domain == "rendered"
    assert again.truth_mesh is None
    assert [(v.view, v.split, v.target_az_deg) for v in again.views] == VIEWS
    assert again.splits() == ("train", "test-17", "test")
    assert [v.view.azimuth_deg for v in again.select("train")] == [0.1, 400.0]
    np.testing.assert_array_equal(again.images("train"), IMAGES[[0, 2]])
    assert again.images("test").dtype == np.float32
    with pytest.raises(SarsplatError, match="no set 'test-15'; it has train, test-17, test"):
        again.images("test-15")


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


def test_truth_mesh(tmp_path):
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    dataset = make(tmp_path / "set", truth_mesh=box)
    assert dataset.truth_mesh == tmp_path / "set" / "truth.ply"
    assert trimesh.load_mesh(dataset.truth_mesh).volume == pytest.approx(6.0)
    dataset.truth_mesh.unlink()
    with pytest.raises(SarsplatError, match=r"lacks its mesh 'truth\.ply'"):
        read_dataset(dataset.path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"images": IMAGES[:3]}, "of shape"),
        ({"images": IMAGES.astype(np.float64)}, "float64"),
        ({"images": np.where(IMAGES[2, 3, 4] == IMAGES, np.nan, IMAGES)}, r"holds nan at \(2, 3, 4\)"),
        ({"images": -IMAGES}, "finite and ≥ 0"),
        ({"views": [(v, "test", a) for v, _, a in VIEWS]}, "nothing to learn from"),
        ({"views": [(v, "validation", a) for v, _, a in VIEWS]}, "'validation'"),
        ({"source": {"x": float("nan")}}, "JSON"),
        ({"source": ["x"]}, "source"),
        ({"domain": "dreamt"}, "'dreamt'"),
    ],
)
def test_wrong_input_writes_nothing(tmp_path, changes, words):
    with pytest.raises(SarsplatError, match=words):
        make(tmp_path / "set", **changes)
    assert list(tmp_path.iterdir()) == []


def test_overwrite(dataset):
    with pytest.raises(SarsplatError, match="--overwrite"):
        make(dataset.path)
    make(dataset.path, images=IMAGES * 2, overwrite=True)
    np.testing.assert_array_equal(dataset.images("test"), IMAGES[[3]] * 2)


def test_missing_empty_and_other_folders(tmp_path, dataset):
    with pytest.raises(SarsplatError, match=r"does not exist; make one with `sarsplat simulate`"):
        read_dataset(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SarsplatError, match="is empty"):
        read_dataset(tmp_path / "empty")
    with pytest.raises(SarsplatError, match="give the folder"):
        read_dataset(dataset.path / "dataset.json")
    with pytest.raises(SarsplatError, match=r"not a dataset: there is no dataset\.json in it; make one"):
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
        ("schema", "other", "schema is not"),
        ("schema_version", 2, "schema_version is 2"),
        ("quantity", "sigma0", "quantity"),
        ("unit", "decibels", "unit"),
        ("domain", None, "domain"),
        ("grid", [], "grid is"),
        ("grid.rows", 6.0, "grid.rows is 6.0"),
        ("grid.rows", True, "grid.rows"),
        ("grid.rows", -1, "empty"),
        ("grid.rows", 7, "shape"),
        ("grid.rows", 10**9, "too large"),
        ("grid.rows", 5, "shape"),
        ("grid.spacing_m", [0.1], "pair"),
        ("grid.spacing_m", [0.1, 0], "positive"),
        ("grid.center_m", [0, 10**400], "pair"),
        ("grid.resolution_m", KeyError, "lacks the field 'resolution_m'"),
        ("grid.tilt", 1, "unknown field 'tilt'"),
        ("source", "somewhere", "object"),
        ("truth_mesh", 3, "truth_mesh"),
        ("truth_mesh", "../x.ply", "does not lie inside"),
        ("views", {}, "a list"),
        ("views", [], "nothing to learn"),
        ("views.0", 7, r"views\[0\] is 7"),
        ("views.1.grazing_deg", 90, r"views\[1\]: grazing angle 90"),
        ("views.1.azimuth_deg", "north", r"views\[1\].azimuth_deg is 'north'"),
        ("views.1.target_az_deg", False, "target_az_deg"),
        ("views.1.split", "TEST", "split"),
        ("views.1.file", "../images/001.tif", "does not lie inside"),
        ("views.1.file", "/etc/passwd", "does not lie inside"),
        ("views.1.file", "images/a\0b.tif", "does not lie inside"),
        ("views.1.file", "", "does not lie inside"),
        ("views.1.file", "images/\x1b[2J.tif", "does not lie inside"),
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
    with pytest.raises(SarsplatError, match="does not lie inside"):
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


def test_damaged_images_never_crash(dataset):
    path = dataset.path / "images" / "000.tif"
    good = path.read_bytes()
    random = np.random.default_rng(2)
    refused = 0
    for _ in range(400):
        bad = bytearray(good)
        for place in random.integers(0, 260, size=random.integers(1, 4)):
            bad[place] = random.integers(256)
        path.write_bytes(bad[: random.integers(1, len(bad) + 1)] if random.random() < 0.3 else bad)
        try:
            power = read_power_tiff(path, (6, 5))
            assert power.shape == (6, 5)
            assert (power >= 0).all()
        except SarsplatError:
            refused += 1
    assert refused > 100


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
