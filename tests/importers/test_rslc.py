"""Images in several polarisations become one stack: order, names, conjugation and scale of the channels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py

from rslcs import IMAGES, RANGES, SPEED, SWATHS, TIMES, halves, write_rslc
from sarsplat.cli import main
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatError
from sarsplat.importers import import_rslc

pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # there is but one view

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "quadpol" / "alos_rio_branco_trihedral.h5"
RNG = np.random.default_rng(0)
QUAD = {name: (RNG.integers(-50, 50, (40, 30, 2)) @ [1, 1j]).astype(np.complex64) for name in ("VH", "VV", "HH", "HV")}
"""Whole numbers, which 16-bit floats hold."""


def imported(folder: Path, images=QUAD, changed=None, look="Right", **options) -> Dataset:
    path = write_rslc(folder / "quad.h5", images, changed or {}, look)
    options = {"size_m": 68.0, "calibration": "absolute", "overwrite": True, **options}
    return import_rslc(path, folder / "out", **options)


@pytest.mark.parametrize("stored", [halves, np.asarray], ids=["16 bits", "32 bits"])
def test_channels_are_those_of_the_file(tmp_path, stored):
    made = imported(tmp_path, {name: stored(image) for name, image in QUAD.items()}, cross="both", pixel=(21, 14))
    [stack] = made.stacks
    assert stack.polarisations == ("HH", "HV", "VH", "VV")  # received, transmitted: the other way round than the file
    for channel, name in enumerate(("HH", "VH", "HV", "VV")):
        np.testing.assert_array_equal(made.signal[0, channel], QUAD[name][11:31, 8:19].T)
    assert stack.offsets_rad == (0.0,) * 4
    assert stack.wavelength_m == pytest.approx(299_792_458 / 1.25e9)
    assert made.grid.spacing_m == pytest.approx((SPEED * 5e-4, 6.0))
    assert made.grid.resolution_m == pytest.approx((0.886 * SPEED / 1500, 0.886 * 299_792_458 / 40e6))
    assert made.grid.azimuth_m[10] == pytest.approx(0) and made.grid.range_m[6] == pytest.approx(0)  # the spot
    assert read_dataset(tmp_path / "out").fingerprint() == made.fingerprint()


def test_cross_polarised_channels_become_their_mean(tmp_path):
    made = imported(tmp_path)
    assert made.stacks[0].polarisations == ("HH", "HV", "VV")
    cut = np.s_[10:30, 10:21]
    np.testing.assert_array_equal(made.signal[0, 1], ((QUAD["HV"][cut] + QUAD["VH"][cut]) / 2).T)
    [said] = [text for text in made.source["assumptions"] if text.startswith("HV and VH are one channel")]
    assert "coherence 0." in said
    made = imported(tmp_path, {"HH": QUAD["HH"], "HV": QUAD["HV"]})
    assert made.stacks[0].polarisations == ("HH", "VH")


@pytest.mark.parametrize("look", ["Right", "Left"])
def test_one_polarisation_is_a_plain_image(tmp_path, look):
    several = imported(tmp_path, look=look, pixel=(21, 14), cross="both")
    channel = several.stacks[0].polarisations.index("VH")  # received, transmitted
    made = imported(tmp_path, {"HV": QUAD["HV"]}, look=look, pixel=(21, 14))
    assert not made.stacks
    np.testing.assert_array_equal(made.signal[0], several.signal[0, channel])
    assert made.grid == several.grid and made.views == several.views
    assert any("it has one, HV" in text for text in made.source["assumptions"])
    assert read_dataset(tmp_path / "out").fingerprint() == made.fingerprint()


def test_views_are_those_of_the_geolocation(tmp_path):
    view = imported(tmp_path, pixel=(20, 8), size_m=50.0).views[0]
    expected = np.interp(RANGES[8], RANGES[[0, -1]], np.cos(np.radians([60.0, 50.0])))
    assert view.azimuth_deg == pytest.approx(180)
    assert math.cos(math.radians(view.grazing_deg)) == pytest.approx(expected)
    assert imported(tmp_path, heading_deg=270.0).views[0].azimuth_deg == pytest.approx(0)
    assert imported(tmp_path, heading_deg=0.0).views[0].azimuth_deg == pytest.approx(270)


NODES = np.arange(-500.0, 1501.0, 500.0), 99.8 + 0.15 * np.arange(5), 799e3 + 1000.0 * np.arange(5)
"""Heights, times and ranges of a geolocation grid, as far apart as NISAR's."""


def on_orbit(longitude_deg: float, height_m: float, time_s: float, range_m: float) -> np.ndarray:
    """Longitude and latitude, degrees, of what is to the right of a circular orbit at zero Doppler, by pyproj alone."""
    pyproj, optimize = pytest.importorskip("pyproj"), pytest.importorskip("scipy.optimize")
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    radius, rate = 7.12e6, np.radians(0.06)  # m, rad/s
    node, inclined, along = np.radians(longitude_deg - 4.0), np.radians(98.4), np.radians(40.0) + rate * (time_s - 100)
    upwards = np.array([-np.sin(node) * np.cos(inclined), np.cos(node) * np.cos(inclined), np.sin(inclined)])
    ahead = np.array([np.cos(node), np.sin(node), 0.0])
    radar = radius * (np.cos(along) * ahead + np.sin(along) * upwards)
    flight = np.cos(along) * upwards - np.sin(along) * ahead

    def astray(place: np.ndarray) -> Any:
        line = np.array(to_ecef.transform(*place, height_m)) - radar
        return np.linalg.norm(line) - range_m, line @ flight

    below = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*radar)
    return np.asarray(optimize.fsolve(astray, (below[0] + 3.0, below[1]), xtol=1e-13))


def grid_on_orbit(longitude_deg: float, turned: bool = False) -> dict[str, Any]:
    places = np.array([[[on_orbit(longitude_deg, h, t, r) for r in NODES[2]] for t in NODES[1]] for h in NODES[0]])
    west = np.full(places.shape[:3], np.sqrt(1 - np.sin(np.radians(55.0)) ** 2))
    step = -1 if turned else 1
    return {
        "Grid/heightAboveEllipsoid": NODES[0][::step],
        "Grid/zeroDopplerTime": NODES[1],
        "Grid/slantRange": NODES[2],
        "losUnitVectorX": -west,
        "losUnitVectorY": 0 * west,
        "groundTrackVelocity": 0 * west + SPEED,
        "epsg": np.int32(4326),
        "coordinateX": ((places[::step, ..., 0] + 180) % 360) - 180,
        "coordinateY": places[::step, ..., 1],
    }


@pytest.mark.parametrize(("longitude", "height", "turned"), [(10.0, 0.0, False), (187.92, 812.0, True)])
def test_the_place_on_earth_is_that_of_the_spot(tmp_path, longitude, height, turned):
    """Where range, zero Doppler and height meet; the second grid lies across 180°."""
    pyproj = pytest.importorskip("pyproj")
    changed = grid_on_orbit(longitude, turned)
    if turned:
        assert np.ptp(changed["coordinateX"]) > 300
    made = imported(tmp_path, changed=changed, height_m=height, heading_deg=30.0, pixel=(21, 14))
    place = made.place
    truth = on_orbit(longitude, height, TIMES[0] + 21 * 5e-4, RANGES[0] + 14 * 6.0)
    metres = pyproj.Geod(ellps="WGS84").inv(*truth, place.longitude_deg, place.latitude_deg)[2]
    assert metres < 0.2
    assert (place.height_m, place.height_above, place.x_towards_deg) == (height, "ellipsoid", 30.0)
    assert read_dataset(tmp_path / "out").place == place
    higher = on_orbit(longitude, height + 10, TIMES[0] + 21 * 5e-4, RANGES[0] + 14 * 6.0)
    aside = pyproj.Geod(ellps="WGS84").inv(*truth, *higher)[2] / 10
    [said] = [text for text in made.source["assumptions"] if "for each metre by which the spot is higher" in text]
    assert f"moves by {aside:.2g} m sideways" in said


@pytest.mark.parametrize(
    "changed",
    [
        {"epsg": np.int32(32632)},
        {"epsg": None},
        {"coordinateX": None},
        {"coordinateY": np.zeros((2, 2))},
        {"coordinateY": np.full((5, 5, 5), 91.0)},
        {"coordinateY": np.full((5, 5, 5), np.nan)},
        {"coordinateY": 10 + np.random.default_rng(0).normal(size=(5, 5, 5))},
        {"Grid/zeroDopplerTime": np.floor(NODES[1])},
    ],
)
def test_a_grid_that_does_not_tell_the_place_leaves_it_out(tmp_path, changed):
    assert imported(tmp_path, changed={**grid_on_orbit(10.0), **changed}).place is None
    assert imported(tmp_path).place is None


def test_a_coarse_grid_may_fall(tmp_path):
    """Heights from above, and the values with them."""
    west = np.cos(np.radians([[[60.0, 50.0]], [[62.0, 52.0]]])) * np.ones((2, 2, 1))
    grid = {"Grid/heightAboveEllipsoid": np.array([-500.0, 500.0]), "losUnitVectorX": -west}
    falling = {name: values[::-1] for name, values in grid.items()}
    rising, turned = (imported(tmp_path, changed=one, height_m=200.0) for one in (grid, falling))
    assert rising.views == turned.views


def test_images_that_were_never_written_are_named(tmp_path):
    path = write_rslc(tmp_path / "quad.h5", QUAD, {f"A/{name}": None for name in QUAD})
    with h5py.File(path, "a") as file:
        for name in QUAD:
            file.create_dataset(f"{IMAGES}/{name}", (40, 30), "c8")
    with pytest.raises(SarsplatError, match=r"has no pixels of HH, HV, VH, VV in .*; it describes images"):
        import_rslc(path, tmp_path / "out", size_m=68.0)


def test_images_of_a_left_looking_radar_are_laid_out_as_those_of_a_right_looking_one(tmp_path):
    right, left = (imported(tmp_path, look=look, pixel=(21, 14)) for look in ("Right", "Left"))
    np.testing.assert_array_equal(left.signal, right.signal[..., ::-1])
    assert left.grid.azimuth_m[-11] == pytest.approx(0)


@pytest.mark.parametrize(
    ("changed", "options", "words"),
    [
        ({"zeroDopplerTimeSpacing": None}, {}, "has no science/LSAR/RSLC/swaths/zeroDopplerTimeSpacing; get it again"),
        ({"CenterFrequency": np.nan}, {}, "has no finite numbers as .*CenterFrequency"),
        ({"CenterFrequency": 3.0}, {}, "has 3.0 as .*CenterFrequency, not a number from 1e.08 to 1e.12"),
        ({"lookDirection": np.bytes_("up")}, {}, "says that its radar looks 'up', not left or right"),
        ({"frequencyA/slantRange": RANGES[::-1]}, {}, "numbers that do not rise as .*slantRange"),
        ({"Grid/heightAboveEllipsoid": np.array([0.0, 9.0, 3.0])}, {}, "neither rise nor fall as .*heightAbove"),
        ({f"A/{name}": None for name in QUAD}, {}, "no images in .*frequencyA; it describes images without holding"),
        ({"frequencyA/slantRange": RANGES[:-1]}, {}, "40 azimuth times, 29 slant ranges for .40, 30"),
        ({"losUnitVectorX": np.full((2, 2, 2), 2.0)}, {}, "impossible radar direction 2"),
        ({"losUnitVectorX": np.zeros(3)}, {}, r"geolocationGrid of \(3,\) values where its axes have \(2, 2, 2\)"),
        ({"frequencyA/HH": QUAD["HH"][1:]}, {}, r"no images of one size in .*, but \(39, 30\) and \(40, 30\)"),
        ({"frequencyA/HH": np.ones((40, 30))}, {}, "holds real numbers, but the quantity is 'complex'"),
        ({"frequencyA/HH": h5py.SoftLink("/science")}, {}, "HH elsewhere, by a link"),
        ({}, {"size_m": -1.0}, "the size -1 m must be positive"),
        ({}, {"heading_deg": math.nan}, "has no direction"),
    ],
)
def test_what_is_refused(tmp_path, changed, options, words):
    with pytest.raises(SarsplatError, match=words):
        imported(tmp_path, changed=changed, **options)
    assert not (tmp_path / "out").exists()


def test_directions_are_extrapolated_within_a_cell_of_the_grid_and_other_images_are_said(tmp_path):
    nodes = RANGES[0] + np.array([40.0, 140.0])  # of 0 to 174
    west = np.interp(nodes, RANGES[[0, -1]], np.cos(np.radians([60.0, 50.0]))) * np.ones((2, 2, 1))
    path = write_rslc(tmp_path / "a.h5", QUAD, {"Grid/slantRange": nodes, "losUnitVectorX": -west})
    with h5py.File(path, "a") as file:
        file.copy(IMAGES, f"{SWATHS}/frequencyB")
        del file[f"{SWATHS}/frequencyB/HV"], file[f"{SWATHS}/frequencyB/VH"], file[f"{SWATHS}/frequencyB/HH"]
    made = import_rslc(path, tmp_path / "out", size_m=50.0, pixel=(20, 5), images="LSAR/frequencyB")
    whole = imported(tmp_path, pixel=(20, 5), size_m=50.0)
    assert made.views[0].grazing_deg == pytest.approx(whole.views[0].grazing_deg)
    assert any("for the geolocation grid is not in WGS 84" in text for text in made.source["assumptions"])


def test_data_in_other_files_are_not_read(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(40 * 30 * 8))
    path = write_rslc(tmp_path / "a.h5", QUAD, {"frequencyA/HH": None})
    with h5py.File(path, "a") as file:
        outside = [(str(tmp_path / "secret"), 0, 40 * 30 * 8)]
        file[IMAGES].create_dataset("HH", (40, 30), np.complex64, external=outside)
    with pytest.raises(SarsplatError, match="HH in another file"):
        import_rslc(path, tmp_path / "out", size_m=60.0)


def test_other_files_are_refused(tmp_path):
    path, words = tmp_path / "a.h5", []
    for name in (None, "x", SWATHS):
        path.write_bytes(b"II*\0")
        if name:
            with h5py.File(path, "w") as file:
                file.create_group(name)
        with pytest.raises(SarsplatError) as told:
            import_rslc(path, tmp_path / "out", size_m=60.0)
        words.append(str(told.value).removeprefix(f"{path} ").partition(";")[0])
    assert words[0] == "is not an HDF5 file" and words[1].startswith("has none of science/LSAR/RSLC")
    assert words[2] == f"has no images in {IMAGES}"


@pytest.mark.usefixtures("undrawn")
def test_the_command(tmp_path, capsys):
    path, out = write_rslc(tmp_path / "quad.h5", QUAD), tmp_path / "out"
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    assert "HH, HV, VH, VV (transmitted, received)" in " ".join(told.split())
    assert "import with: sarsplat import rslc" in told
    assert main(["import", "rslc", str(path), "--size", "68m", "--pixel", "20,15", "--out", str(out)]) == 0
    assert "1 view of 3 channels" in capsys.readouterr().out
    with h5py.File(tmp_path / "quad.h5", "w") as file:
        file["x"] = 1
    assert main(["info", str(path)]) == 2


@pytest.mark.skipif(not MEASURED.is_file(), reason="the measured trihedral is not here")
def test_a_measured_trihedral_is_bright_in_the_same_pixel_of_both_and_dark_across(tmp_path):
    made = import_rslc(MEASURED, tmp_path / "out", size_m=340.0, cross="both")
    assert made.stacks[0].polarisations == ("HH", "HV", "VH", "VV")
    powers = np.abs(made.signal[0]) ** 2
    peak = np.unravel_index(powers[0].argmax(), powers[0].shape)
    assert np.unravel_index(powers[3].argmax(), powers[3].shape) == peak
    assert (made.grid.range_m[peak[0]], made.grid.azimuth_m[peak[1]]) == pytest.approx((0, 0), abs=1e-6)
    assert 10 * np.log10(powers[1:3, *peak].max() / powers[0][peak]) < -19
    assert -4 < 10 * np.log10(powers[3][peak] / powers[0][peak]) < 0
    assert made.views[0].grazing_deg == pytest.approx(90 - 23.14, abs=0.01)  # of the file's own incidence angle
    mean = import_rslc(MEASURED, tmp_path / "out", size_m=340.0, overwrite=True).signal[0]
    assert 20 * np.log10(abs(mean[1][peak] / mean[0][peak])) < -19
