"""Measured chips written as generated ones are."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chip_files import write_chips
from made import dataset_of, read_table
from sarsplat import ImageGrid, SarsplatError, SarsplatWarning, View, import_folder, import_mstar, write_dataset
from sarsplat.cli import main
from sarsplat.data import read_dataset
from sarsplat.names import ChipScale, Side
from sarsplat.samples import Encoding, write_measured_chips

pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")

CHIPS = (17, 0), (17, 90), (17, 180), (17, 270), (15, 5), (15, 95)
"""Depression angles and azimuths of the chips of each class."""
ROWS = [(*named, *angles) for named in (("T72", "SN_132"), ("BMP2", "9563")) for angles in CHIPS]


def table(out: Path) -> list[dict[str, str]]:
    return read_table(out / "labels.csv")


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Chips, one of them without azimuth, and a dataset of each class."""
    place = tmp_path_factory.mktemp("measured")
    (place / "chips").mkdir()
    labels = write_chips(place / "chips", ROWS)
    labels.write_text(labels.read_text().replace("T72,SN_132,17,17.1,270", "T72,SN_132,17,17.1,"))
    for name in ("T72", "BMP2"):
        out = place / "datasets" / name
        import_mstar(labels.parent, out, labels=labels, target_class=name, train_views="all", split="soc")
    return place


@pytest.fixture
def datasets(imported: Path, tmp_path: Path) -> list[Path]:
    """Copies of these datasets in tmp_path/datasets, and of the chips in tmp_path/chips."""
    shutil.copytree(imported, tmp_path, dirs_exist_ok=True)
    return [tmp_path / "datasets" / name for name in ("T72", "BMP2")]


def test_a_folder_of_each_set_and_class_and_one_table(datasets: list[Path], tmp_path: Path) -> None:
    written = write_measured_chips(datasets, tmp_path / "out", Encoding(format="png"))
    folders = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").glob("*/*"))
    assert folders == ["test-15/BMP2", "test-15/T72", "train/BMP2", "train/T72"]
    assert written.counts == {("train", "T72"): 4, ("train", "BMP2"): 4, ("test-15", "T72"): 2, ("test-15", "BMP2"): 2}
    rows = table(tmp_path / "out")
    assert len(rows) == 12
    assert all((tmp_path / "out" / row["path"]).is_file() for row in rows)
    (unplaced,) = [row for row in rows if not row["azimuth_deg"]]
    assert (unplaced["class"], unplaced["split"], unplaced["target_az_deg"]) == ("T72", "train", "")
    assert [row["target_az_deg"] for row in rows if row["split"] == "test-15"] == ["5.0", "95.0"] * 2
    assert {(row["serial"], row["near_side"]) for row in rows} == {("SN_132", "bottom"), ("9563", "bottom")}
    assert json.loads((tmp_path / "out" / "measured-chips.json").read_text())["format"] == "png"
    write_dataset(tmp_path / "train", read_dataset(datasets[0]).select("train"))
    with pytest.warns(SarsplatWarning, match="has 1 empty folder, the first test-15/T72, so that classes have the"):
        write_measured_chips([tmp_path / "train", datasets[1]], tmp_path / "more", Encoding())
    assert [path.name for path in sorted((tmp_path / "more" / "test-15").iterdir())] == ["BMP2", "T72"]


def test_pixels_are_the_published_ones_scaled_and_cut_alike(datasets: list[Path], tmp_path: Path) -> None:
    write_measured_chips(datasets, tmp_path / "out", Encoding(format="png", crop=10))
    for row in table(tmp_path / "out"):
        published = np.asarray(Image.open(tmp_path / "chips" / row["name"]), np.float64)
        expected = np.maximum(published, 2)[3:13, 3:13]
        stored = np.asarray(Image.open(tmp_path / "out" / row["path"]), np.float64)
        np.testing.assert_allclose(stored, 255 * expected / expected.max(), atol=0.51)
    npy = write_measured_chips(datasets, tmp_path / "npy", Encoding(format="npy", quantity="power", scale="calibrated"))
    assert npy.size == (16, 16)
    dataset = read_dataset(datasets[0])
    np.testing.assert_allclose(
        np.load(tmp_path / "npy" / "train" / "T72" / "00000000.npy"), np.rot90(dataset.power[0], 2), rtol=1e-5
    )


def test_what_does_not_fit_is_refused(datasets: list[Path], tmp_path: Path) -> None:
    cases = [
        (Encoding(format="npy", quantity="complex", scale="max"), datasets, "has no phases"),
        (Encoding(crop=17), datasets, "crop is 17, but the images of .* have 16 × 16 pixels"),
        (Encoding(), [tmp_path / "chips"], "is not a dataset and contains none"),
        (Encoding(), [tmp_path / "datasets", datasets[0]], "T72 is named twice"),
    ]
    for encoding, given, sentence in cases:
        with pytest.raises(SarsplatError, match=sentence):
            write_measured_chips(given, tmp_path / "out", encoding)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("key", "value"), [("file", "../x.tif"), ("set", "../../x")])
def test_a_list_that_leads_elsewhere_is_refused(datasets: list[Path], tmp_path: Path, key: str, value: str) -> None:
    header = datasets[0] / "dataset.json"
    content = json.loads(header.read_text())
    content["source"]["unplaced"][0][key] = value
    header.write_text(json.dumps(content))
    with pytest.raises(SarsplatError, match="invalid chip without azimuth"):
        write_measured_chips(datasets, tmp_path / "out", Encoding())
    assert not (tmp_path / "out").exists()


def test_the_command_takes_a_folder_of_datasets(
    datasets: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["chips", "--measured", str(tmp_path / "datasets"), "--out", str(tmp_path / "out"), "--crop", "12"]
    assert main(words) == 0
    assert "12 chips of 2 classes (8 train, 4 test-15), 12 × 12 pixels" in capsys.readouterr().out
    assert main(words) == 2
    assert main([*words, "--overwrite"]) == 0
    assert main([*words, "--overwrite", "--count", "3"]) == 2
    assert "draws no chips, but --count was given" in capsys.readouterr().err


def test_labels_say_what_is_unusual_about_views(tmp_path: Path) -> None:
    views = [View(0.0, 30.0), View(50.0, 30.0, 5.0, "left")]
    power = np.ones((2, 16, 20), np.float32)
    power[:, 5:9, 6:12] = 20
    dataset = dataset_of(
        ImageGrid(16, 20, (0.2, 0.2), (0.3, 0.3)), [(views[0], "train"), (views[1], "test")], power, target="T72"
    )
    write_dataset(tmp_path / "data", dataset)
    write_measured_chips([tmp_path / "data"], tmp_path / "out", Encoding())
    level, tilted = table(tmp_path / "out")
    assert (level["tilt_deg"], level["look"]) == ("0.0", "right")
    assert (tilted["tilt_deg"], tilted["look"]) == ("5.0", "left")


@pytest.mark.parametrize(("scale", "near"), [("max", "bottom"), ("fixed", "left")])
def test_magnitudes_of_chips_scaled_alone(datasets: list[Path], tmp_path: Path, scale: ChipScale, near: Side) -> None:
    out, labels = tmp_path / "out", tmp_path / "out" / "labels.csv"
    write_measured_chips(datasets, out, Encoding(scale=scale, jpeg_quality=100, near=near))
    assert (len({row["dn_per_magnitude"] for row in table(out)}) > 1) == (scale == "max")
    measured = read_dataset(datasets[1])
    again = import_mstar(out, tmp_path / "a", labels=labels, target_class="BMP2", train_views="all", split="soc")
    folder = import_folder(out, tmp_path / "b", target_class="BMP2")
    assert again.splits() == measured.splits()
    published = {
        round(entry.view.azimuth_deg, 3): np.sqrt(measured.power[k]) for k, entry in enumerate(measured.entries)
    }
    for dataset in (again, folder):
        for entry, power in zip(dataset.entries, dataset.power, strict=True):
            expected = published[round(entry.view.azimuth_deg, 3)]
            assert np.abs(np.sqrt(power) - expected).mean() < 0.02 * expected.mean()


def test_power_in_eight_bits_is_read_as_power_or_not_at_all(datasets: list[Path], tmp_path: Path) -> None:
    out, labels = tmp_path / "out", tmp_path / "out" / "labels.csv"
    write_measured_chips(datasets, out, Encoding(format="png", quantity="power"))
    with pytest.raises(
        SarsplatError, match="which is for power, but they are taken for amplitude; give `quantity='power'`"
    ):
        import_folder(out, tmp_path / "a", target_class="BMP2", quantity="amplitude")
    with pytest.raises(SarsplatError, match=r"is at the bottom \(near_side\), but `near` is top; leave it out"):
        import_folder(out, tmp_path / "a", target_class="BMP2", near="top")
    back = import_folder(out, tmp_path / "a", target_class="BMP2", ground=False)
    measured = read_dataset(datasets[1])
    np.testing.assert_allclose(back.power[0], measured.power[0], atol=0.03 * measured.power.max())
    write_measured_chips(datasets, out, Encoding(quantity="power"), overwrite=True)
    with pytest.raises(SarsplatError, match="so its chips hold power, but MSTAR's hold magnitude"):
        import_mstar(out, tmp_path / "b", labels=labels, target_class="BMP2", train_views="all", split="soc")


def test_chips_without_azimuth_travel_with_their_dataset(datasets: list[Path], tmp_path: Path) -> None:
    read = read_dataset(datasets[0])
    write_dataset(tmp_path / "copy", read)
    assert (tmp_path / "copy/unplaced/0000.tif").read_bytes() == (datasets[0] / "unplaced/0000.tif").read_bytes()
    counts = write_measured_chips([tmp_path / "copy"], tmp_path / "a", Encoding()).counts
    assert counts == {("train", "T72"): 4, ("test-15", "T72"): 2}
    with pytest.warns(SarsplatWarning, match="left out 1 chip without azimuth of T72"):
        write_dataset(tmp_path / "brighter", replace(read, power=2 * read.power))
    with pytest.warns(SarsplatWarning, match="differ from those in its folder"):
        written = write_dataset(tmp_path / "train", read.select("train"))
    for name in ("brighter", "train"):
        assert "unplaced" not in read_dataset(tmp_path / name).source
    assert "unplaced" not in written.source
    assert write_measured_chips([tmp_path / "train"], tmp_path / "b", Encoding()).counts == {("train", "T72"): 3}
