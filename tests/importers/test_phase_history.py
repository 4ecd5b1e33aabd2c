"""Phase history: points are focused where the radar frame says, as sharp as theory says, and bad files are refused."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from pulses import FREQUENCIES, C, circle, peak, record, write
from sarsplat.cli import main
from sarsplat.cli.importers import recognised
from sarsplat.data import read_dataset
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.geometry.responses import TAYLOR, UNIFORM, Taylor
from sarsplat.importers import import_phase_history, phase_combining, phase_history
from sarsplat.importers.histories import FORMATS, PhaseHistoryFormat, read_phase_history
from sarsplat.importers.history_gotcha import read_gotcha
from sarsplat.importers.mat import read_mat
from sarsplat.importers.phase_apertures import apertures, whole_flight
from sarsplat.importers.phase_combining import Combined
from sarsplat.importers.phase_history import PhaseHistory, Recorded, flights
from sarsplat.importers.phase_history_images import _edge, focus, ground_points

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "gotcha"
needs_measured = pytest.mark.skipif(not MEASURED.is_dir(), reason="the measured GOTCHA files are not here")
pytestmark = pytest.mark.filterwarnings(
    "ignore:(the training views leave|there is one training view|resolutions differ)"
)


def aperture(path, antenna, points, around=(0.0, 0.0, 0.0)):
    (flight,) = flights([read_gotcha(write(path / "a.mat", record(antenna, points)))])
    (found,) = apertures(flight, np.array(around), None)
    return found


@pytest.mark.parametrize("weighting", [UNIFORM, Taylor()])
def test_agrees_with_a_direct_sum(tmp_path, weighting):
    found = aperture(tmp_path, circle(np.linspace(50, 52, 40)), [(1, 2, 0), (-2, 0.5, 1)])
    grid = ImageGrid(20, 24, (0.15, 0.1), (0.1, 0.1), (0.3, -0.2))
    image = focus(found, grid, weighting)
    history, cross = found.history, found.cross
    middle = (cross.min() + cross.max()) / 2
    pulses = np.abs(np.gradient(cross)) * weighting.window((cross - middle) / found.extent)
    count = history.frequencies
    frequencies = history.first_hz + np.arange(count)[:, None] * history.step_hz
    band = weighting.window((np.arange(count) - (count - 1) / 2) / count)
    beyond = np.linalg.norm(ground_points(found, grid)[:, None] - history.antenna_m, axis=2) - history.reference_m
    phase = 4 * np.pi / C * frequencies[:, None, :] * beyond
    direct = np.einsum("fp,f,p,fnp->n", history.samples, band / band.sum(), pulses / pulses.sum(), np.exp(1j * phase))
    direct = direct.reshape(image.shape) * np.exp(-4j * np.pi / C * history.carrier_hz * grid.range_m)[:, None]
    assert np.abs(image - direct).max() < 1e-5 * np.abs(direct).max()


GEOMETRIES = {
    "left": (np.linspace(-1, 1, 60), 30.0, (0.0, 0.0, 0.0)),
    "right": (np.linspace(1, -1, 60), 30.0, (0.0, 0.0, 0.0)),
    "from the back, steep": (np.linspace(171, 174, 80), 60.0, (0.0, 0.0, 0.0)),
    "across the turn of 180°": (np.linspace(181, 179, 60), 20.0, (0.0, 0.0, 0.0)),
    "beside the centre": (np.linspace(-101, -98, 80), 45.0, (3.0, -2.0, 0.5)),
}


@pytest.mark.parametrize("name", GEOMETRIES)
def test_a_point_is_where_the_radar_frame_says(tmp_path, name):
    degrees, grazing, around = GEOMETRIES[name]
    for offset in ((0.0, 0.0, 0.0), (0.7, 0.4, 0.0), (-0.5, 0.8, 0.6)):
        point = np.array(around) + offset
        found = aperture(tmp_path, circle(degrees, grazing), [tuple(point)], around)
        antenna = found.history.antenna_m
        to_middle = antenna.mean(axis=0) - around
        turn = found.view.azimuth_deg - View.towards(to_middle).azimuth_deg
        assert (turn + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
        assert found.view.grazing_deg == pytest.approx(View.towards(to_middle).grazing_deg, abs=0.02)
        assert found.looks_left == (degrees[-1] > degrees[0])
        grid = ImageGrid(80, 80, (0.03, 0.03), found.resolution_m(Taylor()))
        image = focus(found, grid, Taylor())
        azimuth, _, distance = radar_frame(found.view) @ np.array(offset)
        assert peak(image, grid) == pytest.approx((azimuth, distance), abs=0.01)  # of cells of 0.15 m and more
        assert np.abs(image).max() == pytest.approx(1, abs=0.03)  # its amplitude


@pytest.mark.parametrize(("weighting", "side_lobe_db"), [(UNIFORM, -13.26), (Taylor(), -35.0)])
def test_width_and_side_lobes_are_those_of_theory(tmp_path, weighting, side_lobe_db):
    found = aperture(tmp_path, circle(np.linspace(10, 11.5, 150)), [(0, 0, 0)])
    resolution = found.resolution_m(weighting)
    bandwidth = np.ptp(FREQUENCIES) * 64 / 63
    sweep = np.radians(1.5) * 150 / 149 * np.cos(np.radians(30))
    predicted = weighting.width * C / 2 / np.array([35e9 * sweep, bandwidth])
    assert resolution == pytest.approx(predicted, rel=1e-3)
    fine = tuple(value / 20 for value in resolution)
    for rows, columns in ((201, 1), (1, 201)):
        image = focus(found, ImageGrid(rows, columns, fine, resolution), weighting).ravel()
        power = 20 * np.log10(np.abs(image) / np.abs(image).max())
        above = np.interp(0, power[100:120][::-1] + 10 * np.log10(2), np.arange(119, 99, -1))
        assert 2 * (above - 100) / 20 == pytest.approx(1, abs=0.01)  # in resolutions
        beyond = power[100 + int(np.argmax(np.diff(power[100:]) > 0)) :]  # from the first zero on
        assert beyond.max() == pytest.approx(side_lobe_db, abs=0.7)


@pytest.fixture
def files(tmp_path):
    """Twelve degrees of flight in four files, each going on with the one before; a point 1 m towards +x."""
    edges = np.linspace(-6, 6, 241)
    return [write(tmp_path / f"{k}.mat", record(circle(edges[60 * k : 60 * k + 60]), [(1, 0, 0)])) for k in range(4)]


def test_sub_apertures(files, tmp_path):
    dataset = import_phase_history(files[::-1], tmp_path / "out", size_m=5, aperture_deg=3, train_views=3)
    assert [entry.split for entry in dataset.entries].count("train") == 3
    assert dataset.grid.response == read_dataset(tmp_path / "out").grid.response == Taylor(35, 4)
    views = {entry.name: entry.view for entry in dataset.entries}
    azimuths = [views[f"{k:03d}"].azimuth_deg for k in range(4)]
    assert azimuths == pytest.approx([4.5, 1.5, 358.5, 355.5], abs=0.03)  # theirs are counter-clockwise, ours are not
    assert [view.grazing_deg for view in views.values()] == pytest.approx([30] * 4, abs=0.02)
    assert dataset.signal is not None
    assert dataset.calibration == "relative"
    parts = dataset.source["apertures"]
    assert [part["pulses"] for part in parts] == pytest.approx([60] * 4, abs=1)
    assert {part["looks"] for part in parts} == {"left"}
    assert any("looked to its left" in text for text in dataset.source["assumptions"])
    for index in range(4):
        image = dataset[index]
        azimuth, _, distance = radar_frame(image.view) @ np.array([1.0, 0, 0])
        assert peak(image.signal, image.grid) == pytest.approx((azimuth, distance), abs=0.02)
    np.testing.assert_array_equal(read_dataset(tmp_path / "out").signal, dataset.signal)


def test_the_default_aperture_makes_square_cells_of_all_pulses(files, tmp_path):
    dataset = import_phase_history(files, tmp_path / "out", size_m=5, weighting="uniform")
    square = np.degrees(1e9 * 64 / 63 / 35e9 / np.cos(np.radians(30)))  # 1.92°
    assert len(dataset) == round(12 / square)
    assert sum(part["pulses"] for part in dataset.source["apertures"]) == 240
    azimuth, distance = dataset.grid.resolution_m
    assert azimuth == pytest.approx(distance, rel=0.1)
    assert dataset.grid.spacing_m == pytest.approx([2 / 3 * min(azimuth, distance)] * 2, rel=0.01)


def test_another_format_is_known_by_how_its_files_begin(files, tmp_path, monkeypatch):
    toy = PhaseHistoryFormat("toys (.toy)", (".toy",), lambda _: read_gotcha(files[0]), b"TOY")
    monkeypatch.setattr(FORMATS, "loaded", lambda: {"toy": toy})
    for name in ("a.toy", "b"):
        (tmp_path / name).write_bytes(b"TOY")
        assert len(read_phase_history(tmp_path / name)) == len(read_gotcha(files[0]))
        found = recognised(tmp_path / name)
        assert found is not None and found[0] == "phase-history"


def test_a_file_without_an_ending_is_known_by_its_container(files, tmp_path):
    bare = tmp_path / "pulses"
    bare.write_bytes(files[0].read_bytes())
    assert len(read_phase_history(bare)) == len(read_gotcha(files[0]))


def test_other_flights_are_kept_apart(files, tmp_path):
    higher = write(tmp_path / "higher.mat", record(circle(np.linspace(-6, 6, 240), 50.0), [(1, 0, 0)]))
    dataset = import_phase_history([files[0], higher, files[1]], tmp_path / "out", size_m=2, aperture_deg=6)
    assert [round(entry.view.grazing_deg) for entry in dataset.entries] == [30, 50, 50]


def test_the_autofocus_is_applied(tmp_path):
    antenna, rng = circle(np.linspace(-1, 1, 50)), np.random.default_rng(2)
    clean = record(antenna, [(0.5, 0.3, 0.0)])
    distance, phase = rng.normal(0, 0.05, 50), rng.uniform(-3, 3, 50)
    shaken = {**clean, "af": {"r_correct": distance, "ph_correct": phase}}
    turned = np.exp(-1j * phase - 4j * np.pi / C * FREQUENCIES[:, None] * -distance)
    shaken["fp"] = (clean["fp"] * turned).astype(np.complex64)
    datasets = [
        import_phase_history([write(tmp_path / "a.mat", data)], tmp_path / "out", size_m=4, overwrite=True)
        for data in (clean, shaken)
    ]
    np.testing.assert_allclose(datasets[1].signal, datasets[0].signal, atol=1e-3 * np.abs(datasets[0].signal).max())


@pytest.mark.parametrize("turn", [1, -1])
def test_what_stands_up_is_where_a_tilted_view_says(tmp_path, turn):
    """Of a flight that climbs, or that dives when flown the other way; beside its place if the axis is level."""
    degrees, point = np.linspace(-1, 1, 60), np.array([0.4, -0.3, 0.7])
    antenna = circle(degrees)
    antenna[:, 2] += 0.5 * np.linalg.norm(antenna[0, :2]) * np.radians(degrees)  # half as fast as it goes on
    write(tmp_path / "a.mat", record(antenna[::turn], [tuple(point)]))
    with pytest.warns(UserWarning, match=r"inclined, .* turned by up to 23\.\d° about the line of sight; .*tilted"):
        level = import_phase_history([tmp_path / "a.mat"], tmp_path / "level", size_m=3, spacing_m=0.04)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "the flight is inclined")
        tilted = import_phase_history([tmp_path / "a.mat"], tmp_path / "out", size_m=3, spacing_m=0.04, tilted=True)
    off = []
    for dataset in (level, tilted):
        image = dataset[0]
        place = radar_frame(image.view)[[0, 2]] @ point
        off.append(np.abs(np.array(peak(image.signal, image.grid)) - place).max())
    (view,) = tilted.views
    assert level.views[0].tilt_deg == 0
    assert abs(view.tilt_deg) == pytest.approx(np.degrees(np.arctan(0.5 * np.cos(np.radians(30)))), abs=0.5)
    assert tilted.source["apertures"][0]["tilt_deg"] == view.tilt_deg
    assert off[0] > 0.25
    assert off[1] < 0.01
    # the plane that the pulses span holds the azimuth axis
    across = antenna[-1] - antenna[0]
    assert abs(radar_frame(view)[1] @ across) < 1e-3 * np.linalg.norm(across)
    if turn == 1:  # sharper, for the way across is longer
        assert tilted.grid.resolution_m[0] < 0.95 * level.grid.resolution_m[0]


@pytest.mark.usefixtures("undrawn")
def test_the_command(files, tmp_path, capsys):
    words = [*map(str, files), "--out", str(tmp_path / "out"), "--size", "4m", "--aperture", "4", "--around", "1,0"]
    assert main(["import", "phase-history", *words]) == 0
    told = capsys.readouterr().out
    assert "3 views" in told
    assert "looked to its left" in told
    dataset = read_dataset(tmp_path / "out")
    assert dataset.source["around_m"] == [1, 0, 0]
    assert peak(dataset[0].signal, dataset.grid) == pytest.approx((0, 0), abs=0.02)
    for wrong, said in (("--around=here", "write it as 12,-7.5"), ("--size=wide", "is not a number; write it as 64")):
        assert main(["import", "phase-history", *words, "--overwrite", wrong]) == 2
        assert said in capsys.readouterr().err


@needs_measured
def test_measured_pulses_are_sharp_and_the_autofocus_makes_them_so():
    path = next(MEASURED.glob("*az001*.mat"))
    (found,) = apertures(*flights([read_gotcha(path)]), around_m=np.zeros(3), width_deg=None)
    grid = ImageGrid(60, 60, (0.3, 0.3), (0.3, 0.3), (-21.0, 10.5))  # around a calibration target
    as_flown = read_mat(path)["data"]
    raw = replace(found.history, reference_m=as_flown["r0"].ravel().astype(float), samples=as_flown["fp"])
    contrast = []
    for history in (raw, found.history):
        power = np.abs(focus(replace(found, history=history), grid, Taylor())) ** 2
        contrast.append(np.square(power).mean() / power.mean() ** 2)
    assert contrast[1] > 1.05 * contrast[0] > 100


POINTS = [((0, 0, 0), 1.0), ((4, -3.5, 0), 1.0), ((-4.5, 4.8, 0), 0.5), ((1.5, 2, 1), 1.0)]
OUTSIDE = [((8, 15, 0), 100.0), ((0, -22, 0), 30.0)]
"""Much brighter, and where an image of too few pulses would show them."""


class InFile(Recorded):
    def __init__(self, samples):
        self.samples = samples

    @property
    def shape(self):
        return self.samples.shape

    def part(self, pulses):
        return InFile(self.samples[:, pulses])

    def read(self):
        return self.samples


def flight(pulses, degrees, distance_m, *, rises_deg=0.0, sways_m=0.0, jitter_m=0.0, gap=False, recorded=False):
    """Past the scene, with a climb, a slow sway, independent errors of its places, or pulses missing."""
    along = np.linspace(-1, 1, pulses)
    azimuth, height = np.radians(degrees / 2 * along), np.radians(35 + rises_deg * along**2)
    level = np.cos(height)
    antenna = distance_m * np.stack([np.cos(azimuth) * level, -np.sin(azimuth) * level, np.sin(height)], axis=1)
    random = np.random.default_rng(0)
    antenna += sways_m * np.stack([np.sin(9 * along), np.cos(7 * along), np.sin(11 * along + 1)], axis=1)
    antenna += jitter_m * random.normal(size=antenna.shape)
    if gap:
        antenna = np.delete(antenna, np.r_[pulses // 3 : pulses // 3 + 40, random.integers(0, pulses, 20)], axis=0)
    count = len(antenna)
    first_hz, step_hz = np.full(count, 9.3e9), np.full(count, 2e6)
    reference = np.linalg.norm(antenna - (30, 20, 0), axis=1)  # elsewhere than the middle of the image
    frequencies = first_hz + 2e6 * np.arange(200)[:, None]
    samples = sum(
        amplitude * np.exp(-4j * np.pi / C * frequencies * (np.linalg.norm(antenna - point, axis=1) - reference))
        for point, amplitude in POINTS + OUTSIDE
    ).astype(np.complex64)
    return PhaseHistory("made", first_hz, step_hz, antenna, reference, InFile(samples) if recorded else samples)


FLIGHTS = {
    "from space": dict(pulses=1200, degrees=2, distance_m=7e5),
    "from the air": dict(pulses=1200, degrees=2, distance_m=1e4),
    "the other way": dict(pulses=1200, degrees=-2, distance_m=1e4),
    "wide": dict(pulses=3000, degrees=30, distance_m=5e3),
    "rising": dict(pulses=1200, degrees=3, distance_m=1e4, rises_deg=0.3),
    "swaying": dict(pulses=1200, degrees=2, distance_m=1e4, sways_m=2.0),
    "with gaps": dict(pulses=1200, degrees=2, distance_m=1e4, gap=True),
}


def combined(aperture, grid):
    return Combined.around(aperture.history, aperture.around_m, _edge(aperture, grid), aperture.cross)


@pytest.mark.parametrize("name", FLIGHTS)
def test_makes_the_image_of_all_pulses_from_a_part_of_them(name, monkeypatch):
    aperture = whole_flight(flight(**FLIGHTS[name]), np.zeros(3))
    grid = ImageGrid(13, 10, (1.0, 1.0), aperture.resolution_m(TAYLOR))
    told = []
    image = focus(aperture, grid, TAYLOR, told.append)
    assert len(combined(aperture, grid).kept) < len(aperture.history) / 2
    assert sum(told) == len(aperture.history)
    monkeypatch.setattr(phase_combining, "_WORTH", 0.0)
    assert len(combined(aperture, grid).kept) == len(aperture.history)
    np.testing.assert_allclose(image, focus(aperture, grid, TAYLOR), atol=1e-5 * np.abs(image).max())


def test_pulses_that_others_say_nothing_of_are_all_kept():
    aperture = whole_flight(flight(1200, 2, 1e4, jitter_m=0.01), np.zeros(3))
    grid = ImageGrid(50, 40, (0.25, 0.25), aperture.resolution_m(TAYLOR))
    assert len(combined(aperture, grid).kept) == len(aperture.history)


def test_a_small_image_takes_few_pulses():
    aperture = whole_flight(flight(1200, 2, 1e4), np.zeros(3))
    for side in (1, 3, 6):
        grid = ImageGrid(side, side, (0.25, 0.25), aperture.resolution_m(TAYLOR))
        assert len(combined(aperture, grid).kept) < 20


def test_an_antenna_that_rises_where_it_all_but_stands_still_is_no_reason_to_run_out_of_memory():
    along = np.linspace(-1, 1, 1200)
    places, turns = along**9, np.stack([1e3 * along, -1e3 * along], axis=1)
    kept, weights = phase_combining._few(places, turns)
    assert len(kept) == 1200
    assert (weights != sparse.eye_array(1200)).nnz == 0


def test_reads_piece_by_piece_what_it_would_read_at_once(monkeypatch):
    image = {}
    for recorded in (False, True):
        aperture = whole_flight(flight(1200, 2, 7e5, recorded=recorded), np.zeros(3))
        monkeypatch.setattr(phase_history, "_AT_A_TIME", 7 * 200)
        image[recorded] = focus(aperture, ImageGrid(20, 20, (0.25, 0.25), aperture.resolution_m(TAYLOR)), TAYLOR)
    np.testing.assert_allclose(image[True], image[False], atol=1e-6 * np.abs(image[False]).max())
