"""Tables of pictures as people have them: names, hidden files, angles of two kinds."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import numpy as np
import pytest

from made_imports import POWER, import_pictures, write_pictures
from sarsplat.errors import SarsplatError, SarsplatWarning

ANGLES = (0, 90, 180, 270)


def pictures(tmp_path: Path, cells: list[str], names: str = "file,azimuth,grazing") -> Path:
    """Four pictures, 0.npy to 3.npy, and a table whose rows are an azimuth between these cells."""
    folder = write_pictures(tmp_path / "in", POWER)
    rows = [cell.format(index=index, azimuth=ANGLES[index]) for index, cell in enumerate(cells)]
    (folder / "angles.csv").write_text("\n".join([names, *rows]) + "\n", encoding="utf-8")
    return folder


def test_names_that_differ_in_capital_letters_or_accents(tmp_path):
    folder = pictures(tmp_path, ["{index}.NPY,{azimuth},30"] * 3 + ["café,{azimuth},30"])
    (folder / "3.npy").rename(folder / unicodedata.normalize("NFD", "Café.npy"))
    with pytest.warns(SarsplatWarning, match=r"spells 4 files otherwise .* the first of them '0.NPY' for 0.npy"):
        assert len(import_pictures(folder)) == 4


def test_names_that_may_be_two_files(tmp_path):
    folder = pictures(tmp_path, ["A.npy,{azimuth},30"] + ["{index}.npy,{azimuth},30"] * 3)
    for name in ("a.npy", "a.NPY"):
        (folder / name).write_bytes((folder / "0.npy").read_bytes())
    with pytest.raises(SarsplatError, match=r"line 2: 'A.npy' may be a.NPY and a.npy; write the name as the file's"):
        import_pictures(folder)


@pytest.mark.parametrize("name", ["C:\\data\\0.npy", "C:/data/0.npy", "\\\\server\\data\\0.npy", "/data/0.npy"])
def test_paths_of_another_machine(tmp_path, name):
    folder = pictures(tmp_path, [f"{name},{{azimuth}},30"] * 4)
    with pytest.raises(SarsplatError, match=r"line 2: the path .* points outside the folder of pictures; use paths"):
        import_pictures(folder)


@pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")
def test_incidence_angles_in_radians_and_azimuths_in_thousandths(tmp_path):
    made = import_pictures(pictures(tmp_path, ["{index},{azimuth},1.047"] * 4, "file,azimuth,incidence"))
    assert "the incidence angles (1.047° to 1.047°) look like radians" in made.source["contradictions"][0]
    with pytest.raises(SarsplatError, match=r"line 3: azimuth is '90000'; directions are degrees, -360 to 360"):
        import_pictures(pictures(tmp_path, ["{index},{azimuth}000,30"] * 4))


@pytest.mark.parametrize(
    ("named", "columns", "sentence"),
    [
        ("Azimuth (grad)", {}, "'Azimuth .grad.' for the azimuth, whose name does not state one unit of angle"),
        ("azimuth,GaindB", {"scale": "GaindB"}, "'GaindB' for the scale, .* of a linear factor; give factors .x dB"),
        ("azimuth,gap_hz", {"spacing": "gap_hz"}, "'gap_hz' for the spacing, whose name does not state one unit of"),
        ("azimuth_m", {}, "'azimuth_m' for the azimuth, whose name does not state one unit of angle; give degrees"),
        ("bearing", {}, r"looks like the azimuth; name it with .* \(there are file, bearing, grazing\)"),
        ("bearing", {"azimuth": "bearing"}, "'bearing' for the azimuth, a direction of sight by its name"),
        ("Track", {"azimuth": "Track"}, "columns={'heading': 'Track'}` and give `look`, or rename it"),
        ("compass_deg", {"azimuth": "compass_deg"}, "'compass_deg' for the azimuth, which counts from north"),
    ],
)
def test_columns_that_say_that_they_are_no_degrees_from_the_nose(tmp_path, named, columns, sentence):
    folder = pictures(tmp_path, ["{index},{azimuth},30" + ",30" * named.count(",")] * 4, f"file,{named},grazing")
    with pytest.raises(SarsplatError, match=sentence):
        import_pictures(folder, columns=columns)
    if "north" in sentence:
        turned = import_pictures(folder, columns=columns, azimuth_offset_deg=-30)
        assert [view.azimuth_deg for view in turned.views] == [330, 60, 150, 240]


@pytest.mark.parametrize(
    ("names", "look"),
    [("azimuth,track,course,bearing", None), ("heading,bearing", "right"), ("heading,az,aspect", "left")],
)
def test_columns_that_are_not_needed_block_no_table(tmp_path, names, look):
    cells = {"azimuth": 0, "track": 90, "course": 91, "heading": 90 if look == "right" else -90}
    rows = [[k, *(angle + cells.get(name, 180) for name in names.split(",")), 30] for k, angle in enumerate(ANGLES)]
    folder = write_pictures(tmp_path / "in", POWER, rows, f"file,{names},grazing")
    columns = {"heading": "heading"} if "aspect" in names else None
    assert [view.azimuth_deg for view in import_pictures(folder, look=look, columns=columns).views] == list(ANGLES)


@pytest.mark.parametrize(
    ("names", "turn", "length"),
    [
        ("file,azimuth_rad,grazing (rad),pixel_spacing_cm", 57.29577951308232, 10),
        ("file,Azimuth (gon),Grazing (gon),spacing (mm)", 0.9, 100),
        ("file,azimuth (mrad),grazing_deg,PixelSpacingFeet", 0.05729577951308232, 1 / 3.048),
    ],
)
def test_units_in_names_of_columns_are_converted(tmp_path, names, turn, length):
    """Azimuths 0° to 270°, 30° above the horizon, with pixels of 10 cm."""
    grazing = 30 if "grazing_deg" in names else 30 / turn
    cells = [f"{k}.npy,{azimuth / turn},{grazing},{length}" for k, azimuth in enumerate(ANGLES)]
    folder = pictures(tmp_path, cells, names)
    made = import_pictures(folder, spacing_m=None, resolution_m=None)
    assert [view.azimuth_deg for view in made.views] == pytest.approx(ANGLES)
    assert made.views[0].grazing_deg == pytest.approx(30)
    assert made.grid.spacing_m == pytest.approx((0.1, 0.1))


def test_sides_that_are_near_are_those_of_the_table(tmp_path):
    straight = import_pictures(pictures(tmp_path, ["{index},{azimuth},30"] * 4))
    names = "file,azimuth,grazing,near_side"
    folder = pictures(tmp_path, ["{index},{azimuth},30,Bottom"] * 3 + ["{index},{azimuth},30,"], names)
    turned = import_pictures(folder)
    np.testing.assert_array_equal(turned.power[:3], np.rot90(straight.power[:3], 2, axes=(1, 2)))
    np.testing.assert_array_equal(turned.power[3], straight.power[3])
    assert any("at the side that the table says" in text for text in turned.source["assumptions"])


def test_hidden_files_are_left_out(tmp_path, recwarn):
    folder = pictures(tmp_path, ["{index},{azimuth},30"] * 4)
    (folder / "__MACOSX").mkdir()
    for name in ("._angles.csv", "._0.npy", "__MACOSX/angles.csv"):
        (folder / name).write_bytes(b"\0\5\x16\7")
    assert len(import_pictures(folder)) == 4
    assert not [one for one in recwarn if "has no row" in str(one.message)]


def test_grazing_and_incidence_angles_belong_together(tmp_path):
    names = "file,azimuth,depression,incidence"
    folder = pictures(tmp_path, ["{index},{azimuth},31,59.4"] * 4, names)
    assert {view.grazing_deg for view in import_pictures(folder).views} == {31.0}
    folder = pictures(tmp_path, ["{index},{azimuth},31,59"] * 2 + ["{index},{azimuth},31,55"] * 2, names)
    with pytest.raises(SarsplatError, match=r"line 4: depression is 31° and incidence is 55°, which do not add to 90°"):
        import_pictures(folder)
    made = import_pictures(folder, columns={"incidence": "incidence"})
    assert sorted({view.grazing_deg for view in made.views}) == [31.0, 35.0]
    folder = pictures(tmp_path, ["{index},{azimuth},,59"] * 2 + ["{index},{azimuth},31,"] * 2, names)
    assert {view.grazing_deg for view in import_pictures(folder).views} == {31.0}
