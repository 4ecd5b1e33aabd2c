"""CPHD: points are imaged where they are, whatever the domain, the sign, the SRPs, the band."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sarkit")

import lxml.etree
import sarkit.cphd

from cphds import PLACE, C, Collection, arc, metadata, simulated, write_cphd, xml_of
from fuzz import watched
from pulses import peak, peak_beside
from sarsplat.cli import main
from sarsplat.data import Dataset, read_dataset
from sarsplat.geometry import ImageGrid, radar_frame
from sarsplat.geometry.responses import TAYLOR, UNIFORM
from sarsplat.importers import import_phase_history
from sarsplat.importers.history_cphd import read_cphd
from sarsplat.importers.phase_apertures import whole_flight
from sarsplat.importers.phase_history_images import focus

pytestmark = pytest.mark.filterwarnings("ignore::sarsplat.errors.SarsplatWarning")  # there is but one view

POINTS = [((0.0, 0.0, 0.0), 1.0), ((3.0, 2.0, 0.0), 0.8), ((-4.0, 1.0, 2.0), 0.9j)]
ARC = arc(200.0, 4.0, 80)
PULSES = len(ARC)


def imported(folder: Path, made: Collection, points=POINTS, **options) -> Dataset:
    path = write_cphd(folder / "a.cphd", made, points)
    return import_phase_history([path], folder / "out", **{"size_m": 14.0, "overwrite": True, **options})


def check_points(dataset: Dataset, points=POINTS, origin=(0.0, 0.0, 0.0)) -> None:
    """Each is within a tenth of a cell of its place and, against the first, within 0.3 dB of its level."""
    image = dataset[0]
    levels = []
    for place, amplitude in points:
        azimuth, _, away = radar_frame(image.view) @ (np.array(place) - origin)
        off, level = peak_beside(image.signal, image.grid, azimuth, away)
        assert np.abs(off / image.grid.resolution_m).max() < 0.1
        levels.append(20 * math.log10(level / abs(amplitude)))
    assert np.ptp(levels) < 0.3


OTHER_BANDS = {"shift": np.linspace(-3, 3, PULSES), "stretch": np.linspace(0.99, 1.01, PULSES)}
KINDS = {
    "frequencies": {},
    "the other sign": {"sign": 1},
    "times": {"domain": "TOA"},
    "times, the other sign": {"domain": "TOA", "sign": 1},
    "version 1.0.1": {"version": "1.0.1"},
    "16-bit numbers": {"form": "CI4"},
    "8-bit numbers": {"form": "CI2"},
    "scaled": {"scaled": np.geomspace(1e-3, 1e3, PULSES)},
    "times, scaled": {"domain": "TOA", "scaled": np.geomspace(1e-3, 1e3, PULSES)},
    "received elsewhere": {"moved": np.tile([6.0, -2.0, 0.5], (PULSES, 1))},
    "another band each": OTHER_BANDS,
    "times, another band each": {"domain": "TOA", **OTHER_BANDS},
    "another image plane": {"bearing": 210.0},
}


@pytest.mark.parametrize("name", KINDS)
def test_points_are_where_they_are_and_as_bright(tmp_path, name):
    made = Collection(ARC, **KINDS[name])
    dataset = imported(tmp_path, made)
    check_points(dataset)
    view = dataset[0].view
    assert view.azimuth_deg == pytest.approx(110.0, abs=0.1)  # x is east, so bearings are azimuths + 90°
    assert view.grazing_deg == pytest.approx(35.0, abs=0.1)
    assert dataset.place is not None and dataset.place.x_towards_deg == 90
    assert dataset.place.ecef == pytest.approx(PLACE.ecef, abs=1e-6)
    assert dataset.source["apertures"][0]["looks"] == "right"
    assert dataset.source["collections"][0]["collector"] == "Made up"
    read = read_dataset(tmp_path / "out")
    assert read.place == dataset.place
    np.testing.assert_array_equal(read.signal, dataset.signal)


def test_amplitudes_and_widths_are_those_of_points_in_either_domain(tmp_path):
    for domain in ("FX", "TOA"):
        path = write_cphd(tmp_path / f"{domain}.cphd", Collection(ARC, domain=domain), [((0.2, -0.1, 0.0), 3.0)])
        aperture = whole_flight(read_cphd(path), np.zeros(3))
        assert aperture.resolution_m(UNIFORM)[1] == pytest.approx(UNIFORM.width * C / 2 / 0.5e9, rel=0.02)
        image = focus(aperture, ImageGrid(40, 40, (0.05, 0.05), aperture.resolution_m(TAYLOR)), TAYLOR)
        assert np.abs(image).max() == pytest.approx(3.0, rel=0.01)


def test_stabilisation_points_may_move(tmp_path):
    moving = np.stack([np.linspace(-30, 30, PULSES), np.linspace(5, -5, PULSES), np.sin(np.arange(PULSES))], axis=1)
    fixed = imported(tmp_path, Collection(ARC, srp=(1.0, 2.0, 3.0), swath=60.0, samples=200))
    moved = imported(tmp_path, Collection(ARC, srp=moving, swath=60.0, samples=200))
    check_points(moved)
    np.testing.assert_allclose(moved.signal, fixed.signal, atol=1e-4 * np.abs(fixed.signal).max())


def test_pulses_without_a_signal_are_left_out(tmp_path):
    signal = np.ones(PULSES)
    signal[10:14] = 0
    signal[70] = 3
    scaled = np.where(signal == 1, 1.0, 1e-7)  # 140 dB too strong if they were used
    dataset = imported(tmp_path, Collection(ARC, signal=signal, scaled=scaled))
    assert dataset.source["apertures"][0]["pulses"] == PULSES - 5
    check_points(dataset)


def test_of_a_strip_the_pulses_that_saw_the_place_are_used(tmp_path):
    """A straight flight along x, 400 m to the east; what is seen moves with the antenna, for 0.1 s."""
    east = np.linspace(-200, 200, 401)
    antenna = np.stack([east, np.full(401, -3000.0), np.full(401, 2000.0)], axis=1)
    srp = np.stack([east, np.zeros(401), np.zeros(401)], axis=1)
    made = Collection(antenna, srp=srp, dwell=(0.2, 0.001, 0.1), swath=40.0, samples=200)
    points = [((60.0, 0.0, 0.0), 1.0), ((63.0, 2.0, 0.0), 0.7)]
    path = write_cphd(tmp_path / "a.cphd", made, points)
    dataset = import_phase_history([path], tmp_path / "out", size_m=10.0, around_m=(60.0, 0.0, 0.0))
    check_points(dataset, points, origin=(60.0, 0.0, 0.0))
    [part] = dataset.source["apertures"]
    assert part["pulses"] == pytest.approx(101 - 10, abs=2)  # 0.1 s, less what its western or eastern edge was not seen
    sweep = 90.0 / np.hypot(3000.0, 2000.0)
    assert part["resolution_m"][0] == pytest.approx(TAYLOR.width * C / 2 / 9.65e9 / sweep, rel=0.02)
    assert part["looks"] == "left"
    assert dataset.views[0].azimuth_deg == pytest.approx(90.0, abs=0.2)  # from the south


def test_a_place_on_earth_is_the_origin(tmp_path):
    latitude, longitude, height = PLACE.to_geodetic(np.array(POINTS[1][0]))
    for options in ({"place": (latitude, longitude, height)}, {"around_m": POINTS[1][0]}):
        dataset = imported(tmp_path, Collection(ARC), **options)
        check_points(dataset, origin=POINTS[1][0])
        assert peak(dataset[0].signal, dataset.grid) != pytest.approx((0, 0), abs=0.1)  # the brightest is another
        assert dataset.place is not None
        assert dataset.place.to_ecef(np.zeros(3)) == pytest.approx(PLACE.to_ecef(np.array(POINTS[1][0])), abs=1e-6)
    level = imported(tmp_path, Collection(ARC), place=(latitude, longitude))
    assert level.place is not None and level.place.height_m == pytest.approx(PLACE.height_m)


def test_several_files_are_of_one_world(tmp_path):
    paths = [
        write_cphd(tmp_path / f"{azimuth}.cphd", Collection(arc(azimuth, 4.0, 80), domain=domain), POINTS)
        for azimuth, domain in ((20, "FX"), (140, "TOA"), (260, "FX"))
    ]
    dataset = import_phase_history(paths, tmp_path / "out", size_m=14.0, place=(*PLACE.to_geodetic(np.ones(3)),))
    assert [round(view.azimuth_deg) for view in dataset.views] == [290, 50, 170]
    for index in range(3):
        check_points(dataset.take([index]), origin=(1.0, 1.0, 1.0))


def test_channels_are_chosen_by_name(tmp_path, capsys):
    made = Collection(ARC, channels=("near", "far side"))
    path = write_cphd(tmp_path / "a.cphd", made, POINTS)
    words = ["import", "phase-history", str(path), "--size", "14", "--out", str(tmp_path / "out")]
    for channel, told in (([], "several channels"), (["--channel", "up"], "no channel 'up'")):
        assert main([*words, *channel]) == 2
        told = rf"has {told}; choose .*channel.* among 'near' \(V:V\), 'far side' \(H:V\)"
        assert re.search(told, " ".join(capsys.readouterr().err.split()))
    peaks = [np.abs(next(read_cphd(path, name).pieces())[1]).max() for name in made.channels]
    assert peaks[1] == pytest.approx(2 * peaks[0])
    check_points(imported(tmp_path, made, channel="far side"))


@pytest.mark.usefixtures("undrawn")
def test_the_commands(tmp_path, capsys):
    path = write_cphd(tmp_path / "a b.cphd", Collection(ARC), POINTS)
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    for words in (
        "CPHD files (.cphd)", "1.1.0", "Made up", "V:V", "47.376900° N, 8.541700° E", "430.0 m above the ellipsoid",
        "looks right, 4 km away at the compass bearing 200.0°", "505.3 MHz about 9.65 GHz", "4° of azimuth",
        "0.241 m × 0.263 m", "80, of 96 frequencies", "import with: sarsplat import phase-history",
    ):  # fmt: skip
        assert words in told, words
    words = ["import", "phase-history", str(path), "--size", "14", "--out", str(tmp_path / "out")]
    assert main([*words, "--place=47.3769,8.5417", "--aperture", "2"]) == 0
    told = capsys.readouterr().out
    assert "2 views" in told
    assert "the origin of the scene is 47.376900° N, 8.541700° E (WGS 84), 430.0 m above the ellipsoid" in told
    (tmp_path / "folder").mkdir()
    for name in "ab":
        (tmp_path / "folder" / f"{name}.cphd").write_bytes(path.read_bytes())
    assert main(["info", str(tmp_path / "folder")]) == 0
    assert "1.1.0" in capsys.readouterr().out


@pytest.mark.parametrize("version", ["1.0.1", "1.1.0"])
def test_the_files_are_valid(version, tmp_path):
    """What these tests write is what the standard's schema asks for."""
    made = Collection(ARC, version=version)
    schema = lxml.etree.XMLSchema(file=str(list(sarkit.cphd.VERSION_INFO.values())[version == "1.1.0"]["schema"]))
    data, values = simulated(made, POINTS)
    schema.assertValid(lxml.etree.fromstring(metadata(made, values, data.shape[1])))
    assert xml_of(write_cphd(tmp_path / "a.cphd", made, POINTS).read_bytes()) == metadata(made, values, data.shape[1])


def test_memory_holds_some_pulses_at_a_time(tmp_path):
    """A file of 8 MiB, which would be 32 MiB as amplitudes, and 64 MiB with weights."""
    made = Collection(arc(200.0, 2.0, 2000), samples=2048, form="CI2", swath=300.0)
    path = write_cphd(tmp_path / "a.cphd", made, POINTS[:1])
    read_cphd(path)  # with all that is loaded for it
    with watched() as cost:
        dataset = import_phase_history([path], tmp_path / "out", size_m=3.0)
    assert len(dataset) == 1
    assert cost.bytes < 40 << 20
