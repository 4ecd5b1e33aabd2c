"""A folder of pictures and a table, written in many ways, become one dataset."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from made_imports import AZIMUTHS, PHASE, POWER, import_pictures, rewrite, write_pictures
from sarsplat.cli import main
from sarsplat.data import read_dataset
from sarsplat.data.sidecar import read_unplaced
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.examination import contradictions
from sarsplat.examination.contradictions import examine
from sarsplat.importers import import_folder, import_mstar

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "mstar"
SIGNAL = (np.sqrt(POWER) * np.exp(1j * PHASE)).astype(np.complex64)


def command(folder: Path, *more: str, quantity: str = "power", spacing: str = "0.1") -> list[str]:
    out = ["--out", str(folder.parent / "out"), "--quantity", quantity]
    return ["import", "folder", str(folder), *out, "--spacing", spacing, *more]


def test_what_is_written_is_what_was_there(tmp_path):
    made = import_pictures(write_pictures(tmp_path / "in", POWER))
    np.testing.assert_array_equal(made.power, POWER)
    assert [(view.azimuth_deg, view.grazing_deg) for view in made.views] == [(azimuth, 30) for azimuth in AZIMUTHS]
    assert (made.grid.rows, made.grid.columns) == (20, 26)
    assert (made.grid.spacing_m, made.grid.resolution_m) == ((0.1, 0.3), (0.2, 0.4))
    assert (made.target, made.looks, made.ground, made.splits()) == ("in", 1.0, True, ("train",))
    assert read_dataset(tmp_path / "out").fingerprint() == made.fingerprint()
    assert "columns of the table: file = file, azimuth = azimuth, grazing = grazing" in made.source["assumptions"]


@pytest.mark.parametrize("ending", ["npy", "tif"])
def test_the_phase_is_kept(tmp_path, ending):
    made = import_pictures(write_pictures(tmp_path / "in", SIGNAL, ending=ending), quantity=None)
    np.testing.assert_array_equal(made.signal, SIGNAL)
    np.testing.assert_array_equal(read_dataset(tmp_path / "out").signal, SIGNAL)
    assert "the numbers are complex" in made.source["assumptions"]


def test_sixteen_bits_of_amplitude_and_eight_of_decibels(tmp_path):
    amplitude = np.round(np.sqrt(POWER) * 9000).astype(np.uint16)
    decibels = np.round((10 * np.log10(POWER) + 20) * 255 / 40).astype(np.uint8)
    folder = write_pictures(tmp_path / "in", amplitude, ending="png")
    made = import_pictures(folder, quantity=None, calibration="relative")
    np.testing.assert_allclose(made.power, POWER / POWER.mean(), rtol=2e-3)
    assert "the numbers are amplitude" in made.source["assumptions"]
    write_pictures(folder, decibels, ending="png")
    np.testing.assert_allclose(import_pictures(folder, quantity="db", scale=40 / 255, offset=-20).power, POWER, 0.02)


def test_a_dataset_shows_one_class(tmp_path):
    rows = [[f"{k}.npy", azimuth, 30, "tank" if k < 3 else "car"] for k, azimuth in enumerate(AZIMUTHS)]
    folder = write_pictures(tmp_path / "in", POWER, rows, "file,azimuth,grazing,class")
    made = import_pictures(folder, target_class="tank")
    np.testing.assert_array_equal(made.power, POWER[:3])
    assert made.target == "tank"
    with pytest.warns(SarsplatWarning, match="there is one training view"):
        assert import_pictures(folder, target_class="car", target="mine").target == "mine"


def test_pictures_without_azimuth_are_kept_apart_and_counted(tmp_path):
    rows = [[f"{k}.npy", "" if k == 1 else azimuth, 30] for k, azimuth in enumerate(AZIMUTHS)]
    folder = write_pictures(tmp_path / "in", POWER, rows, "file,azimuth,grazing")
    with pytest.warns(SarsplatWarning, match=r"no azimuth \(azimuth\) for 1 picture of 4 \(the first in line 3\)"):
        made = import_pictures(folder)
    np.testing.assert_array_equal(made.power, POWER[[0, 2, 3]])
    kept = {"name": "1.npy", "file": "unplaced/0000.tif", "set": "train", "grazing_deg": 30}
    assert made.source["unplaced"] == [kept]
    np.testing.assert_array_equal(read_unplaced(made, made.path, kept["file"]), POWER[1])
    np.save(folder / "1.npy", np.zeros_like(POWER[1]))
    with pytest.warns(SarsplatWarning):
        made = import_pictures(folder)
    assert 0 < read_unplaced(made, made.path, kept["file"]).max() < POWER.min()
    np.save(folder / "1.npy", POWER[1, 2:-2])
    less = r"1\.npy, without azimuth, shows less than the others; remove it"
    with pytest.warns(SarsplatWarning), pytest.raises(SarsplatError, match=less):
        import_pictures(folder)
    write_pictures(tmp_path / "none", POWER, [[row[0], "", 30] for row in rows], "file,azimuth,grazing")
    with pytest.raises(SarsplatError, match="line 2: azimuth is ''; give a number"):
        import_pictures(tmp_path / "none")


@pytest.mark.parametrize(("ending", "world"), [("tif", "tfw"), ("tif", "tifw"), ("png", "pgw"), ("png", "wld")])
def test_a_world_file_beside_a_picture_is_said(tmp_path, ending, world):
    pixels = np.round(np.sqrt(POWER) * 9000).astype(np.uint16)
    folder = write_pictures(tmp_path / "in", pixels, ending=ending)
    (folder / f"0.{world}").write_text("0.5\n0\n0\n-0.5\n500000\n5200000\n")
    with pytest.warns(SarsplatWarning, match=rf"0\.{ending} has the world file 0\.{world} beside it, by which"):
        import_pictures(folder, quantity="amplitude")


@pytest.mark.parametrize(("near", "turns"), [("top", 0), ("left", 1), ("bottom", 2), ("right", 3)])
@pytest.mark.parametrize("mirrored", [False, True])
def test_orientation(tmp_path, near, turns, mirrored):
    """What is turned or mirrored in the file is not so in the dataset."""
    lying = np.rot90(POWER[..., ::-1] if mirrored else POWER, turns, axes=(1, 2))
    made = import_pictures(write_pictures(tmp_path / "in", lying), near=near, mirrored=mirrored)
    np.testing.assert_array_equal(made.power, POWER)


def test_a_left_looking_radar_writes_mirror_images(tmp_path):
    sides = ["left", "R", "right", "l"]
    lying = [image[:, ::-1] if side[0].lower() == "l" else image for image, side in zip(POWER, sides, strict=True)]
    rows = [[f"{k}.npy", azimuth, 30, side] for k, (azimuth, side) in enumerate(zip(AZIMUTHS, sides, strict=True))]
    folder = write_pictures(tmp_path / "in", np.stack(lying), rows, "file,azimuth,grazing,look_side")
    np.testing.assert_array_equal(import_pictures(folder).power, POWER)


def test_names_angles_and_lengths_of_a_table_of_ones_own(tmp_path):
    rows = [[f"{k}", 90 - azimuth, 60, 0.2, "Train" if k else "test-a", 1.5] for k, azimuth in enumerate(AZIMUTHS)]
    folder = write_pictures(tmp_path / "in", POWER, rows, "shot,turn,Incidence Angle (deg),px,set,az_std_deg")
    columns = {"file": "shot", "az": "turn", "spacing": "px"}
    angles = {"azimuth_offset_deg": 90, "counter_clockwise": True}
    made = import_pictures(folder, columns=columns, spacing_m=None, resolution_m=None, **angles)
    assert [entry.view.azimuth_deg for entry in made.entries] == [90, 180, 270, 0]  # training views come first
    assert [entry.split for entry in made.entries] == ["train"] * 3 + ["test-a"]
    assert {entry.view.grazing_deg for entry in made.entries} == {30}
    assert {entry.azimuth_std_deg for entry in made.entries} == {1.5}
    assert made.grid.spacing_m == made.grid.resolution_m == (0.2, 0.2)
    assert "the resolution is the pixel spacing" in made.source["assumptions"]


def test_columns_in_the_names_of_pictures(tmp_path, capsys):
    (tmp_path / "in" / "box").mkdir(parents=True)
    for azimuth, split, image in zip(AZIMUTHS, ("train", "test-a", "train", "train"), POWER, strict=True):
        np.save(tmp_path / "in" / "box" / f"shot {azimuth}deg_60.50_{split}.npy", image)
    np.save(tmp_path / "in" / "other.npy", POWER[0])
    names = "shot {azimuth}deg_{inc}_{set}.npy"
    with pytest.warns(SarsplatWarning, match="has no row for 1 picture in"):
        made = import_pictures(tmp_path / "in", names=names)
    assert sorted(entry.view.azimuth_deg for entry in made.entries) == sorted(AZIMUTHS)
    assert {entry.view.grazing_deg for entry in made.entries} == {29.5}
    assert [entry.split for entry in made.entries] == ["train"] * 3 + ["test-a"]
    np.testing.assert_array_equal(made.power[0], POWER[0])
    with pytest.warns(SarsplatWarning, match="has no row for 1 picture in"):
        classed = import_pictures(tmp_path / "in", names="{class}/" + names)
    assert classed.target == "box"
    (tmp_path / "in" / "other.npy").unlink()
    with pytest.raises(SarsplatError, match="no picture called like"):
        import_pictures(tmp_path / "in", names="x{azimuth}_{inc}.npy")
    with pytest.raises(SarsplatError, match="line 1: azimuth is 'shot 0"):
        import_pictures(tmp_path / "in", names="{azimuth}_{inc}_{set}.npy")
    assert main(command(tmp_path / "in", "--overwrite", "--names", "shot {azimuth}_{inc}.npy")) == 2
    assert "inc is '60.50_train'" in " ".join(capsys.readouterr().err.split())


def test_ranges_along_the_ground_are_shorter_in_the_slant_plane(tmp_path):
    made = import_pictures(write_pictures(tmp_path / "in", POWER), ground_range=True, resolution_m=None)
    assert made.grid.spacing_m == pytest.approx((0.1, 0.3 * np.cos(np.radians(30))))
    assert made.grid.resolution_m == made.grid.spacing_m


def test_a_row_goes_before_what_is_said_of_all(tmp_path):
    rows = [[f"{k}.npy", azimuth, "", 2 if k == 1 else ""] for k, azimuth in enumerate(AZIMUTHS)]
    folder = write_pictures(tmp_path / "in", POWER, rows, "file,azimuth,grazing,gain")
    made = import_pictures(folder, columns={"scale": "gain"}, grazing_deg=20.0, scale=3.0)
    np.testing.assert_allclose(made.power[[0, 1]], POWER[[0, 1]] * np.array([3, 2])[:, None, None], rtol=1e-6)
    assert made.views[0].grazing_deg == 20


def test_the_name_itself_goes_before_its_synonyms(tmp_path):
    assert len(import_pictures(write_pictures(tmp_path / "in", POWER, names="file,azimuth,az"), grazing_deg=3)) == 4


def test_strays_are_counted_once(tmp_path):
    folder = write_pictures(tmp_path / "in", POWER)
    (folder / "0.npy").unlink()
    np.save(folder / "more.npy", POWER[0])
    with pytest.warns(SarsplatWarning) as told:
        assert len(import_pictures(folder)) == 3
    texts = [str(one.message) for one in told]
    assert sum("lacks 1 of 4 pictures" in text for text in texts) == 1
    assert sum("has no row for 1 picture" in text for text in texts) == 1


def test_the_command_draws_a_preview_and_says_what_it_took(tmp_path, capsys):
    folder, out = write_pictures(tmp_path / "in", POWER), tmp_path / "out"
    words = command(folder, "0.3", "--columns", "az=azimuth,graz=grazing", "--train-views", "3")
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "assumed: columns of the table: azimuth = azimuth, grazing = grazing, file = file" in told
    assert f"wrote {out}: 4 views (3 train, 1 test) of 2.6 m × 6 m, largest gap of the training views 180°" in told
    with Image.open(out / "preview.png") as preview:
        assert preview.size[0] > 500
    assert main([*words, "--overwrite"]) == 0  # the preview is ours, and replaced with the rest
    assert main([*words, "--overwrite", "--columns", "az"]) == 2
    assert "'az' is not of the form MEANING=NAME" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("looks", "numbers", "wrong", "told", "right"),
    [
        (1, "db in 8 bits", "amplitude", "import with --quantity db", "db --scale 0.2353 --offset -40"),
        (4, "db in 8 bits", "db", "--scale and --offset", "db --scale 0.2353 --offset -40"),
        (1, "amplitude", "db", "--quantity amplitude, or", "amplitude"),
        (4, "db", "power", "import with --quantity db", "db"),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_the_option_for_what_the_numbers_are(tmp_path, capsys, looks, numbers, wrong, told, right):
    rng = np.random.default_rng(0)
    mean = np.where(np.hypot(*np.mgrid[-24:24, -30:30]) < 4, 300, 0.5)
    power = rng.gamma(looks, 1 / looks, size=(8, 48, 60)) * mean
    decibels = 10 * np.log10(power)
    stored = {
        "db in 8 bits": np.clip(np.round((decibels + 40) * 255 / 60), 0, 255).astype(np.uint8),
        "amplitude": np.clip(np.round(np.sqrt(power) * 20), 1, 255).astype(np.uint8),
        "db": (decibels + 90).astype(np.float32),
    }[numbers]
    ending = "tif" if numbers == "db" else "png"
    folder = write_pictures(tmp_path / "in", stored, [[f"{k}.{ending}", 45 * k, 30] for k in range(8)], ending=ending)
    assert main(command(folder, "--overwrite", "--looks", str(looks), quantity=wrong, spacing="0.2")) == 1
    assert told in capsys.readouterr().err
    right, *more = right.split()
    main(command(folder, "--overwrite", "--looks", str(looks), *more, quantity=right, spacing="0.2"))
    assert "--quantity" not in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_an_import_is_examined_once_and_zeros_and_cuts_are_said_once(tmp_path, capsys, monkeypatch):
    seen = []
    monkeypatch.setattr(contradictions, "examine", lambda dataset: seen.append(dataset) or examine(dataset))
    power = [POWER[0], POWER[1][:-2], POWER[2] * (POWER[2] > 0.3), POWER[3]]
    main(command(write_pictures(tmp_path / "in", power)))
    said = "".join(capsys.readouterr())
    assert len(seen) == said.count("held zero") == said.count("cut to what they have in common") == 1


@pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured MSTAR chips are not here")
@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
def test_measured_chips_are_as_their_own_importer_has_them(tmp_path):
    table = Path(shutil.copy(MEASURED / "labels.csv", tmp_path))
    rewrite(
        table, lambda rows: [rows[0], *[row for row in rows if row[1:3] == ["T72", "132"] and row[4] == "17"][::40]]
    )
    own = import_mstar(MEASURED, tmp_path / "a", labels=table, target_class="T72", train_views="all")
    lengths = {"spacing_m": own.grid.spacing_m, "resolution_m": own.grid.resolution_m}
    options = {"columns": {"az": "target_az_deg"}, "near": "bottom", "counter_clockwise": True, **lengths}
    made = import_folder(MEASURED, tmp_path / "b", table=table, **options)
    order = [[entry.name for entry in made.entries].index(entry.name) for entry in own.entries]
    assert made.take(order).views == own.views
    assert np.corrcoef(made.power[order].ravel(), own.power.ravel())[0, 1] > 0.999999  # but for what was zero


@pytest.mark.usefixtures("undrawn")
def test_a_rejected_import_is_said_again_where_it_is_trained_on(tmp_path, capsys):
    folder, out = write_pictures(tmp_path / "in", [np.ones_like(image) for image in POWER]), tmp_path / "out"
    words = command(folder)
    assert main(words) == 1
    shown = capsys.readouterr()
    assert "import again with --overwrite" in shown.out and f"look closer with sarsplat check {out}" in shown.out
    assert (shown.err.count("error: 4 of 4 images are constant"), shown.err.count("error:")) == (1, 1)
    assert "with 1 contradiction" in shown.out and "ready" not in shown.out
    assert main(["info", str(out)]) == 0
    shown = capsys.readouterr()
    assert "contradicted" in shown.out and "1 contradiction, found when it was made" in " ".join(shown.err.split())
    reconstruct = ["reconstruct", str(out), "--out", str(tmp_path / "run"), "--iterations", "1", "--gaussians", "20"]
    main([*reconstruct, "--resume"])
    assert "contradicts" not in capsys.readouterr().err
    assert main(reconstruct) in (0, 2)
    told = capsys.readouterr().err
    assert f"{out} contradicts itself, so the result may be wrong: 4 of 4 images are constant" in told
    assert f"`sarsplat check {out}` explains it" in told
    write_pictures(folder, POWER)
    assert main([*words, "--overwrite"]) == 0
    assert "contradictions" not in read_dataset(out).source


def test_each_import_in_python_warns_of_contradictions_and_keeps_them(tmp_path):
    folder = write_pictures(tmp_path / "in", [np.ones_like(image) for image in POWER])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")  # says a sentence once
        made, _ = import_pictures(folder), import_pictures(folder)
    assert [text for one in told if "constant" in (text := str(one.message))] == 2 * made.source["contradictions"]
    assert read_dataset(tmp_path / "out").source == made.source


def test_warnings_of_an_import_that_fails_are_said(tmp_path, capsys):
    folder = write_pictures(tmp_path / "in", POWER)
    (folder / "0.npy").unlink()
    np.save(folder / "1.npy", PHASE[1].astype(str))
    assert main(["import", "folder", str(folder), "--out", str(tmp_path / "out"), "--spacing", "0.1"]) == 2
    assert "warning:" in capsys.readouterr().err


def test_too_many_files_are_not_cut(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sarsplat.importers.files._MOST_FILES", 5)
    folder = write_pictures(tmp_path / "in", POWER)
    assert len(import_pictures(folder)) == 4
    (folder / "notes.txt").touch()
    with pytest.raises(SarsplatError, match="more than 5 files; give a folder that holds only the pictures"):
        import_pictures(folder)
    assert main(["info", str(folder)]) == 2
    assert "more than 5 files; give a folder that holds only images to import" in capsys.readouterr().err


@pytest.mark.parametrize(("column", "options"), [(["left"], {}), ([], {"mirrored": True})])
def test_the_tilt_is_that_of_the_flight_however_a_left_look_is_said(tmp_path, column, options):
    rows = [[f"{k}.npy", azimuth, 30, 12, *column] for k, azimuth in enumerate(AZIMUTHS)]
    names = "file,azimuth,grazing,tilt" + ",look" * len(column)
    made = import_pictures(write_pictures(tmp_path / "in", POWER[..., ::-1], rows, names), **options)
    np.testing.assert_array_equal(made.power, POWER)
    assert {(view.tilt_deg, view.side) for view in made.views} == {(-12.0, "right")}


def test_the_spacing_of_tags(tmp_path):
    """Columns and rows, whichever of them is range; what is given and contradicts it is refused."""
    folder = write_pictures(tmp_path / "in", POWER, ending="tif")
    for k, power in enumerate(POWER):  # tags that say how far pixels are apart, and nothing of a map
        tags = [(33550, "d", 3, (0.1, 0.3, 0.0), True), (33922, "d", 6, (0.0,) * 6, True)]
        tifffile.imwrite(folder / f"{k}.tif", power, metadata=None, extratags=tags)
    assert import_pictures(folder, spacing_m=None).grid.spacing_m == (0.1, 0.3)
    assert import_pictures(folder, spacing_m=None, near="left").grid.spacing_m == (0.3, 0.1)
    assert import_pictures(folder, spacing_m=(0.1, 0.3)).grid.spacing_m == (0.1, 0.3)
    with pytest.raises(SarsplatError, match=r"are 0\.1 m × 0\.3 m \(azimuth × range\), but 0\.2 × 0\.3 is given"):
        import_pictures(folder, spacing_m=(0.2, 0.3))
