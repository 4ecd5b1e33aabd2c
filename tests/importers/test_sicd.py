"""SICDs become datasets: scatterers land where the frame of the dataset says, with their power and phase."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sarkit")

import lxml.etree

from fuzz import watched
from pulses import peak_beside
from sarsplat.cli import main
from sarsplat.data import Dataset, read_dataset
from sarsplat.errors import SarsplatWarning
from sarsplat.geometry import Place, View, radar_frame
from sarsplat.geometry.responses import GAUSSIAN, UNIFORM, Taylor
from sarsplat.importers import import_sicd
from sarsplat.importers.sicd_file import read_sicd
from sicds import (
    FREQUENCY,
    LIGHT,
    SPOT,
    Recording,
    Track,
    axes,
    describe,
    ecef,
    of_version,
    with_xml,
    write_sicd,
    xml_of,
)

pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # of one view alone, for instance

PLACES = [(0.0, 0.0, 0.0), (8.0, -5.0, 0.0), (-12.0, 9.0, 3.0)]  # m east, north and above the spot
SIZE = 36.0  # m
BETA = (("BetaZero", 2.0),)


def imported(folder: Path, track: Track, recording: Recording, places=PLACES, **options) -> Dataset:
    """The dataset of one SICD."""
    path = write_sicd(folder / "image.nitf", track, places, recording)
    options = {"around": SPOT, "looks": None, "ground": False, "size_m": SIZE} | options
    return import_sicd([path], folder / "set", overwrite=True, **options)


def misses(dataset: Dataset, places=PLACES) -> np.ndarray:
    """How far the brightest pixels are from where the radar frame has the places, in widths of the response."""
    seen = np.array(places) @ radar_frame(dataset.views[0])[[0, 2]].T
    found = [peak_beside(dataset.signal[0], dataset.grid, azimuth, away)[0] for azimuth, away in seen]
    return np.array(found) / dataset.grid.resolution_m


@pytest.mark.parametrize("other", [False, True])
@pytest.mark.parametrize(
    ("swapped", "recording"),
    [
        (False, Recording()),
        (True, Recording(turn=30, offset=(20.0, -15.0, 4.0))),
        (False, Recording(turn=-8, tilt=20)),
        (True, Recording(turn=-75, ground_plane=True, rows=600, columns=600)),
        (False, Recording(kind="XRGYCR", offset=(30.0, 0.0, 0.0))),
        (True, Recording(kind="RGAZIM")),
        (False, Recording(kind="RGZERO", offset=(-6.0, 10.0, 0.0))),
    ],
    ids=["slant", "turned", "tilted", "ground", "another plane", "polar format", "zero Doppler"],
)
def test_scatterers_land_where_the_frame_has_them(tmp_path, swapped, recording, other):
    """From the east and from the west, ascending and descending, with the radar on either side."""
    bearing, look = 283.0 if other else 90.0, "RL"[other != swapped]
    dataset = imported(tmp_path, Track(bearing, 35.0, look), recording)
    [view] = dataset.views
    assert view.azimuth_deg == pytest.approx(bearing - 90, abs=1e-6)
    assert view.grazing_deg == pytest.approx(35, abs=1e-6)
    assert dataset.source["images"][0]["look"] == {"R": "right", "L": "left"}[look]
    assert np.abs(misses(dataset)).max() < 0.02


def test_a_near_radar_and_its_round_wavefronts(tmp_path):
    dataset = imported(tmp_path, Track(200.0, 50.0, distance=4e3), Recording(offset=(3.0, 2.0, 1.0)))
    assert np.abs(misses(dataset)).max() < 0.05


@pytest.mark.parametrize("track", [Track(squint=12), Track(bearing=20, look="L", squint=-20), Track(climb=6)])
def test_tilted_slant_planes_lean_as_stated_unless_they_stay_tilted(tmp_path, track):
    places = [(5.0, -7.0, 0.0), (0.0, 0.0, 2.0), (-3.0, 4.0, 1.0)]
    level = imported(tmp_path, track, Recording(), places)
    low, high, _ = misses(level, places)
    assert np.abs(low).max() < 0.04
    [facts] = level.source["images"]
    assert high * level.grid.resolution_m == pytest.approx(2.0 * np.array(facts["leaning_m_per_m"]), abs=0.04)
    tilt = math.radians(facts["tilt_deg"])
    assert facts["leaning_m_per_m"][0] == pytest.approx(math.tan(tilt) / math.cos(math.radians(35)), rel=1e-3)
    assert any("tilted about the line of sight" in text for text in level.source["assumptions"])

    dataset = imported(tmp_path, track, Recording(), places, tilted=True)
    [facts], [view] = dataset.source["images"], dataset.views
    assert view.tilt_deg == pytest.approx(facts["tilt_deg"], abs=1e-3) and abs(view.tilt_deg) > 3
    assert np.abs(misses(dataset, places)).max() < 0.06
    assert np.abs(facts["leaning_m_per_m"]).max() < 1e-3
    assert not any("tilted about the line of sight" in text for text in dataset.source["assumptions"])
    # a level axis cuts the response of a tilted plane at a slant
    assert dataset.grid.resolution_m[0] == pytest.approx(level.grid.resolution_m[0], rel=0.2)
    assert math.prod(dataset.grid.resolution_m) < math.prod(level.grid.resolution_m)
    assert dataset.grid.response != GAUSSIAN  # its side lobes still run along its axes


@pytest.mark.parametrize("doppler", [(0.0, 0.0), (0.4, -0.9)], ids=["centred band", "band elsewhere"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_resampling_keeps_amplitude_and_phase(tmp_path, doppler, sign):
    """Against the response itself, at the places of the dataset's pixels."""
    track = Track(90.0, 35.0, distance=50e3)
    recording = Recording(turn=20, doppler=doppler, sign=sign, offset=(2.0, -3.0, 0.0), window="TAYLOR")
    place = (4.0, 6.0, 1.5)
    dataset = imported(tmp_path, track, recording, [place], size_m=20.0)
    _, grid_of = describe(track, recording)
    view, grid = dataset.views[0], dataset.grid
    across, rise, away = radar_frame(view)
    azimuth, slant = np.meshgrid(grid.azimuth_m[::5], grid.range_m[::5])
    ground = azimuth[..., None] * across + slant[..., None] * (away - away[2] / rise[2] * rise)
    centre = grid_of(ecef(place))
    expected = np.empty(azimuth.shape, complex)
    for index in np.ndindex(azimuth.shape):
        off = grid_of(ecef(ground[index])) - centre
        lines = []
        for axis in (0, 1):
            band = recording.bandwidth[axis] * off[axis]
            phase = -sign * 2j * np.pi * recording.doppler[axis] * off[axis]
            lines.append((np.sinc(band) + 0.3 * (np.sinc(band + 1) + np.sinc(band - 1))) * np.exp(phase))
        expected[index] = np.prod(lines)
    expected *= np.exp(sign * 4j * np.pi * FREQUENCY / LIGHT * centre[0])
    found = dataset.signal[0, ::5, ::5] * math.sqrt(dataset.source["mean_power"])
    error = np.abs(found - expected).max()
    assert 20 * math.log10(error / np.abs(expected).max()) < -95


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Dataset:
    return imported(tmp_path_factory.mktemp("plain"), Track(), Recording(), size_m=28.0)


@pytest.mark.parametrize(
    ("pixel_type", "table", "tolerance"),
    [
        ("RE32F_IM32F", False, 1e-6),
        ("RE16I_IM16I", False, 1e-3),
        ("AMP8I_PHS8I", False, 0.02),
        ("AMP8I_PHS8I", True, 0.02),
    ],
)
def test_every_pixel_type_means_the_same(tmp_path, plain, pixel_type, table, tolerance):
    dataset = imported(tmp_path, Track(), Recording(pixel_type=pixel_type, amplitude_table=table), size_m=28.0)
    found, expected = dataset.signal[0], plain.signal[0]
    scale = np.vdot(expected, found) / np.vdot(expected, expected)  # quantisation moves the mean power a little
    assert abs(scale - 1) < 0.05 and abs(np.angle(scale)) < 0.01
    assert np.abs(found - scale * expected).max() < tolerance * np.abs(expected).max() + 1e-6
    assert dataset.source["images"][0]["pixel_type"] == pixel_type


@pytest.fixture(scope="module")
def newest(tmp_path_factory) -> tuple[bytes, Dataset]:
    """A file of version 1.4.0, and its dataset."""
    folder = tmp_path_factory.mktemp("newest")
    recording = Recording(kind="RGZERO", pixel_type="RE16I_IM16I", offset=(-6.0, 10.0, 0.0), calibration=BETA)
    made = imported(folder, Track(look="L"), recording, size_m=12.0)
    return (folder / "image.nitf").read_bytes(), made


@pytest.mark.parametrize(
    "version", ["0.4.0", "0.4.1", "0.5.0", "1.0.0", "1.0.1", "1.1.0", "1.2.0", "1.2.1", "1.3.0", "1.4.0", "1.5"]
)
def test_every_version_means_the_same(tmp_path, newest, version, capsys):
    file, expected = newest
    path = tmp_path / "image.nitf"
    path.write_bytes(of_version(file, version))
    options = {"around": SPOT, "looks": None, "ground": False, "size_m": 12.0}
    dataset = import_sicd([path], tmp_path / "set", overwrite=True, **options)
    np.testing.assert_array_equal(dataset.signal, expected.signal)
    assert (dataset.views, dataset.grid) == (expected.views, expected.grid)
    assert dataset.source["images"] == expected.source["images"]
    assert main(["info", str(path)]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    for line in (f"version {version}", "sensor made up", "mode SPOTLIGHT", "date 2024-05-01T00:00:00.000000Z"):
        assert line in lines
    assert "polarisation V:V" in lines and "size 300 rows × 280 columns, 160 m × 160 m" in lines
    assert any(line.startswith("radar looks left, 500 km away at the compass bearing 90") for line in lines)
    assert any(line.startswith("where 47.30") and "pixel 150,140" in line for line in lines)
    assert lines[-1].startswith("import with: sarsplat import sicd")


def test_an_image_in_several_segments_is_one(tmp_path):
    sicd = read_sicd(write_sicd(tmp_path / "image.nitf", Track(), PLACES, Recording()))
    [whole], width = sicd.segments, sicd.segments[0].length // sicd.shape[0]
    first = replace(whole, rows=100, length=100 * width)
    second = replace(whole, offset=whole.offset + first.length, rows=200, length=200 * width)
    for rows in ((90, 130), (0, 80), (150, 300)):
        divided = replace(sicd, segments=[first, second]).read(rows, (5, 50))
        np.testing.assert_array_equal(divided, sicd.read(rows, (5, 50)))


def test_widths_weighting_and_calibration(tmp_path):
    recording = Recording(window="TAYLOR", calibration=BETA, bandwidth=(2.0, 1.0), rows=400, columns=200)
    dataset = imported(tmp_path, Track(), recording, size_m=20.0)
    assert dataset.calibration == "absolute"
    assert dataset.grid.resolution_m == pytest.approx((1.130, 0.565), rel=1e-3)
    assert dataset.grid.spacing_m == pytest.approx((0.8, 0.4), rel=1e-3)
    assert dataset.source["images"][0]["weighting"] == ["TAYLOR", "TAYLOR"]
    relative = imported(tmp_path, Track(), replace(recording, calibration=()), size_m=20.0)
    assert relative.calibration == "relative"
    assert relative.power.mean() == pytest.approx(1, rel=1e-3)
    as_stored = relative.signal * math.sqrt(relative.source["mean_power"])
    assert dataset.signal == pytest.approx(as_stored * math.sqrt(2.0), abs=1e-5)


@pytest.mark.parametrize("track", [Track(), Track(squint=12)])
def test_every_calibration_becomes_beta0(tmp_path, track):
    """By angles that the file states: σ⁰ = β⁰ cos(slope) = γ⁰ sin(grazing); RCS is β⁰ times the response's area."""
    expected = imported(tmp_path, track, Recording(calibration=BETA))
    angles = lxml.etree.fromstring(xml_of((tmp_path / "image.nitf").read_bytes()))
    stated = (angles.findtext(f"{{*}}SCPCOA/{{*}}{one}") for one in ("SlopeAng", "GrazeAng"))
    slope, grazing = (math.radians(float(text)) for text in stated)
    sigma = 2.0 * math.cos(slope)
    factors = {"SigmaZero": sigma, "GammaZero": sigma / math.sin(grazing), "RCS": 2.0 / (1.5 * 1.4)}
    for name, factor in factors.items():
        made = imported(tmp_path, track, Recording(calibration=((name, factor),)))
        assert made.calibration == "absolute"
        assert made.signal == pytest.approx(expected.signal, rel=2e-4, abs=1e-5), name
    with pytest.warns(
        SarsplatWarning, match="BetaZeroSFPoly of image.nitf, .* differs from SigmaZeroSFPoly by 3.0 dB$"
    ):
        imported(tmp_path, track, Recording(calibration=(*BETA, ("SigmaZero", 2 * sigma), ("RCS", factors["RCS"]))))


@pytest.mark.parametrize(
    ("recording", "response"),
    [
        (Recording(), UNIFORM),
        (Recording(window="TAYLOR"), GAUSSIAN),  # of which level?
        (Recording(window="TAYLOR", parameters=(("NBAR", "5"), ("SLL", "-30"))), Taylor(30, 5)),
        (Recording(window="TAYLOR", parameters=(("NBAR", "many"), ("SLL", "-30"))), GAUSSIAN),
        (Recording(window=None), GAUSSIAN),
        (Recording(turn=20), GAUSSIAN),  # its side lobes run beside our axes
    ],
)
def test_the_response_is_that_of_the_weighting(tmp_path, recording, response):
    assert imported(tmp_path, Track(), recording, size_m=10.0).grid.response == response


def test_a_stack_is_on_one_grid_with_headings_and_sets(tmp_path):
    recordings = {0: Recording(), 90: Recording(turn=12), 180: Recording(bandwidth=(1.4, 1.5)), 270: Recording()}
    files = [
        write_sicd(tmp_path / f"{bearing}.nitf", Track(bearing, 30.0, "RL"[bearing // 90 % 2]), PLACES, recording)
        for bearing, recording in recordings.items()
    ]
    dataset = import_sicd(files, tmp_path / "set", size_m=SIZE, around=SPOT, heading_deg=0.0, train_views=2)
    assert dataset.splits() == ("train", "test")
    assert [round(view.azimuth_deg) % 360 for view in dataset.views] == [0, 180, 90, 270]
    assert dataset.signal is not None and read_dataset(tmp_path / "set").signal is not None
    turned = [(north, -east, up) for east, north, up in PLACES]  # x points north
    for index, entry in enumerate(dataset.entries):
        assert np.abs(misses(dataset.take([index]), turned)).max() < 0.05, entry.name


def test_the_spot_may_be_a_pixel_or_the_centre(tmp_path):
    offset = (11.0, -6.0, 0.0)
    recording = Recording(offset=offset)
    by_centre = imported(tmp_path, Track(), recording, [offset], around=None)
    assert np.abs(misses(by_centre, [(0.0, 0.0, 0.0)])).max() < 0.04
    _, grid_of = describe(Track(), recording)
    spot = grid_of(ecef(PLACES[1])) / recording.spacing + [recording.rows // 2, recording.columns // 2]
    by_pixel = imported(tmp_path, Track(), recording, PLACES[1:2], around=None, pixel=tuple(spot))
    assert np.abs(misses(by_pixel, [(0.0, 0.0, 0.0)])).max() < 0.04
    without_height = imported(tmp_path, Track(), recording, around=SPOT[:2])
    assert without_height.source["spot"]["height_m"] == pytest.approx(SPOT[2], abs=1e-3)


def test_the_dataset_knows_its_place(tmp_path):
    dataset = imported(tmp_path, Track(), Recording(offset=(20.0, -15.0, 4.0)), heading_deg=-10.0)
    assert dataset.place == Place(*SPOT, x_towards_deg=350.0)
    assert read_dataset(tmp_path / "set").place == dataset.place
    turned = radar_frame(View(0.0, 30.0))[2] @ dataset.place.axes  # away from a radar that lies ahead of x
    east, north, _ = axes() @ turned
    assert np.degrees(np.arctan2(-east, -north)) == pytest.approx(-10.0)
    centre = imported(tmp_path, Track(), Recording(offset=(20.0, -15.0, 4.0)), around=None)
    np.testing.assert_allclose(centre.place.ecef, ecef((20.0, -15.0, 4.0)), atol=1e-6)


def test_only_what_is_needed_is_read(tmp_path):
    """A chip of a large image: neither memory nor reading grows with it."""
    import sarkit.sicd

    path = write_sicd(tmp_path / "large.nitf", Track(), [(0.0, 0.0, 0.0)], Recording(rows=1400, columns=1400))
    assert path.stat().st_size > 15e6
    import_sicd([path], tmp_path / "first", around=SPOT, size_m=10.0)  # imports are not counted
    assert sarkit.sicd
    with watched() as cost:
        import_sicd([path], tmp_path / "set", around=SPOT, size_m=10.0)
    assert cost.bytes < 12e6
    assert cost.seconds < 2


def test_the_command_says_what_it_assumed(tmp_path, capsys):
    files = [
        str(write_sicd(tmp_path / f"{bearing}.nitf", Track(bearing, look="L"), PLACES, Recording()))
        for bearing in (0, 120, 240)
    ]
    latitude, longitude, height = SPOT
    words = ["import", "sicd", *files, f"--around={latitude},{longitude},{height}", "--size", "48m"]
    words += ["--target", "sphere"]
    assert main([*words, "--out", str(tmp_path / "set")]) == 0
    said = capsys.readouterr().out
    assert "look to the left (3)" in said and "nothing is mirrored" in said
    assert "compass heading 90°" in said and "one factor" in said and "UNIFORM" in said
    assert re.search(r"3 views of 4[78]\.?\d* m × 4[78]\.?\d* m, largest gap 120°, ready", said)
    assert "next: " in said and "reconstruct" in said
    assert read_dataset(tmp_path / "set").target == "sphere"


def test_a_file_whose_projection_leads_elsewhere_is_said(tmp_path, capsys):
    """As of Capella's strip maps by sarpy's converter: 4.6 km beside its scene centre point."""
    path = write_sicd(tmp_path / "a.nitf", Track(bearing=20, grazing=35, look="R"), PLACES, Recording(kind="RGZERO"))
    options = {"size_m": SIZE, "looks": None, "ground": False, "overwrite": True}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        import_sicd([path], tmp_path / "set", **options)
    assert not any("contradicts itself" in str(one.message) for one in caught)
    data = path.read_bytes()
    farther = re.sub(r"(<R_CA_SCP>)([^<]*)", lambda it: f"{it[1]}{float(it[2]) + 500.0}", xml_of(data).decode())
    path.write_bytes(with_xml(data, farther.encode()))
    with pytest.warns(SarsplatWarning, match=r"a\.nitf contradicts itself: its scene centre point is 610\.\d m from"):
        import_sicd([path], tmp_path / "set", pixel=(150, 140), **options)
    assert main(["info", str(path)]) == 0
    assert "a.nitf contradicts itself" in capsys.readouterr().out


def test_other_data_may_come_before_the_metadata(tmp_path):
    """As sarpy writes what is added to a SICD."""
    path = write_sicd(tmp_path / "a.nitf", Track(bearing=20, grazing=35, look="R"), PLACES, Recording())
    plain, data = read_sicd(path), path.read_bytes()
    other = b"DE" + b"NOTES".ljust(25) + b"01U" + b" " * 166 + b"0000" + b"hello world"
    header, body = int(data[354:360]), len(data) - int(data[391:395]) - int(data[395:404])
    assert (data[388:391], data[body : body + 18]) == (b"001", b"DEXML_DATA_CONTENT")
    lengths = b"%012d%06d" % (len(data) + 13 + len(other), header + 13)
    parts = [data[:342], lengths, data[360:388], b"002", b"0200000000011", data[391:body], other, data[body:]]
    path.write_bytes(b"".join(parts))
    read = read_sicd(path)
    assert (read.version, read.shape, read.collection) == (plain.version, plain.shape, plain.collection)
    assert [part.offset - 13 for part in read.segments] == [part.offset for part in plain.segments]
