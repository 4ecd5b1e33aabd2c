"""Pictures of reports: decibels, windows, sheets; and of stacks two passes and a slice through layover."""

import base64
import io
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import trimesh
from PIL import Image

from made import dataset_of
from sarsplat import ImageGrid, ScatteringLaw, Stack, View, preset, reconstruct, simulate_stack, write_report
from sarsplat.data import Dataset, write_dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import radar_frame
from sarsplat.report import Look, contact_sheet, decibel_png, sheet
from sarsplat.report.boards import SIDES, Raster, point_boards
from sarsplat.report.curves import curves_figure
from sarsplat.report.figure import axis, nice, scale_bar
from sarsplat.report.images import Difference, target_window, window
from sarsplat.report.rendered import Rendered, frame
from sarsplat.report.sheet import check_sheet
from sarsplat.report.stacks import Interferogram, Pair, Slice, averaged, brightest_layover, covariances
from sarsplat.report.views import evenly
from sarsplat.runs.run_folder import LogLine


def test_grey_levels_of_the_png() -> None:
    power = np.array([[100.0, 1.0], [0.01, 0.0]])  # 0, −20, −40 dB and nothing
    picture: Any = Image.open(io.BytesIO(decibel_png(power, Look(100.0))))
    assert np.asarray(picture).tolist() == [[255, 128], [0, 0]]
    assert "-40 dB" in picture.text["Description"]


@pytest.mark.parametrize("losses", [(-1e30, 1e30), (1e-320, 1e30), (0.0, 0.0), (1e30, 1e30)])
@pytest.mark.parametrize("counts", [(0, 0), (0, 10**9), (10**9, 10**9)])
def test_curves_of_whatever_a_history_may_hold(losses: tuple[float, float], counts: tuple[int, int]) -> None:
    history = [LogLine(n, 0.0, loss, n) for loss, n in zip(losses, counts, strict=True)]
    for panel in curves_figure(history, "loss", "loss").blocks[0].panels:
        assert "nan" not in panel.drawing
        assert all(0 <= place <= 1 for axis in (panel.across, panel.down) for place, _ in axis.ticks)


@pytest.mark.parametrize(("count", "wanted", "expected"), [(48, 3, [0, 24, 47]), (2, 6, [0, 1]), (1, 6, [0])])
def test_views_are_chosen_evenly(count: int, wanted: int, expected: list[int]) -> None:
    assert evenly(count, wanted) == expected


def test_the_window_holds_every_bright_pixel() -> None:
    truth = np.zeros((2, 64, 64))
    truth[0, 30, 20], truth[1, 40, 35] = 1.0, 1.0
    rows, columns = target_window(truth, peak=1.0)
    assert (truth[:, rows, columns] > 0).sum() == 2
    assert rows.stop - rows.start == columns.stop - columns.start < 40


@pytest.mark.parametrize("spacing_m", [0.02, 0.5])
def test_points_on_a_lattice_are_drawn_without_gaps(spacing_m: float) -> None:
    """Thinning to voxels leaves about one point in each."""
    plate = spacing_m * np.stack(np.meshgrid(np.arange(60.0), np.arange(40.0), [0.0]), axis=-1).reshape(-1, 3)
    (block,), _ = point_boards({"plate": plate}, None, 1.0)
    top = Image.open(io.BytesIO(base64.b64decode(block.panels[2].image.partition(",")[2])))
    covered = np.asarray(top) > 0
    rows, columns = np.nonzero(covered)
    assert covered[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].all()
    assert covered.mean() > 0.8


def test_of_more_points_than_a_picture_can_show_some_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sarsplat.report.boards._MOST_POINTS", 500)
    places = np.random.default_rng(0).uniform(0, 1, (20_000, 3))
    drawn = []
    monkeypatch.setattr("sarsplat.report.boards._point_width_m", lambda cloud: drawn.append(cloud.n) or 0.0)
    (block,), _ = point_boards({"cloud": places}, None, 1.0)
    assert block.title == "cloud, 20,000 points" and drawn == [500]


@pytest.mark.parametrize(("looks", "cells"), [(1.0, 1.0), (4.0, 1.0), (1.0, 2.0)])
def test_speckle_alone_gives_residuals_of_one_sigma(looks: float, cells: float) -> None:
    """Speckle that is independent from one resolution cell of `cells` pixels to the next."""
    rng = np.random.default_rng(0)
    blocks = rng.gamma(looks, 1 / looks, (1, 300, 300))
    measured = np.kron(blocks, np.ones((1, int(cells), int(cells))))
    grid = ImageGrid(*measured.shape[1:], spacing_m=(0.3, 0.3), resolution_m=(0.3 * cells, 0.3 * cells))
    residual = Difference(looks, grid, 10.0).of(5.0 * measured, np.full(measured.shape, 5.0))
    assert residual.mean() == pytest.approx(0, abs=0.05)
    assert residual.std() == pytest.approx(1, rel=0.2)


def test_the_window_of_a_residual_holds_a_resolution_cell() -> None:
    *size, independent = window(ImageGrid(128, 128, spacing_m=(0.2031, 0.2021), resolution_m=(0.3229, 0.3013)))
    assert size == [3, 3]
    assert independent == pytest.approx(9 * 0.2031 / 0.3229 * 0.2021 / 0.3013)
    assert window(ImageGrid(64, 64, spacing_m=(0.1, 0.1), resolution_m=(0.42, 0.1)))[1] == 5


@pytest.mark.parametrize(("low", "high"), [(-6.0, 6.0), (0.0, 1e-4), (3.2, 7.9), (12.0, -3.0), (0.0, 4500.0)])
def test_ticks_are_round_and_within(low: float, high: float) -> None:
    ticks = axis("x, m", low, high).ticks
    assert 2 <= len(ticks) <= 6
    for place, text in ticks:
        number = float(text.replace("−", "-").replace(",", ""))
        assert number == pytest.approx(low + place * (high - low), abs=1e-5 * abs(high - low))


@pytest.mark.parametrize("width_m", [0.07, 9.3, 25.6, 384.0, 12_000.0])
def test_scale_bars_fit(width_m: float) -> None:
    share, text = scale_bar(width_m)
    assert 0.1 < share <= 1 / 3
    number, unit = text.split()
    assert float(number) * {"km": 1e3, "m": 1, "cm": 1e-2}[unit] == pytest.approx(share * width_m)
    assert nice(width_m) <= width_m


def test_a_contact_sheet_shows_the_target_large() -> None:
    grid = ImageGrid(128, 128, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
    images = np.zeros((7, 128, 128))  # and two empty places
    images[:, 60:68, 60:68] = 1.0  # 0.4 % of the image
    views = [View(50.0 * k, 30.0) for k in range(7)]
    sheet = np.asarray(Image.open(io.BytesIO(contact_sheet(images, views, grid, Look(1.0)))).convert("L"))
    assert (sheet > 250).mean() > 0.07


TURNED = [View(20.0, 30.0, tilt, side) for tilt in (0.0, -7.5, 7.5) for side in ("right", "left")]


def test_views_from_one_direction_are_told_apart(tmp_path: Path) -> None:
    """In the names of files, in what files say, on sheets, and in animations, all frames of which are as high."""
    grid, look = ImageGrid(24, 24, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3)), Look(1.0)
    images = np.full((len(TURNED), 24, 24), 0.1, np.float32)
    Rendered(images, TURNED, grid, look).write(tmp_path / "all", seconds=1, overwrite=False)
    names = sorted(path.stem for path in (tmp_path / "all").glob("*.tif"))
    assert len(names) == len(TURNED)
    assert names[0] == "az020_gr30"
    assert {"az020_gr30_left", "az020_gr30_tilt7.5"} < set(names)
    with tifffile.TiffFile(tmp_path / "all" / "az020_gr30_tilt-7.5_left.tif") as file:
        assert "grazing 30 deg, tilted by -7.5 deg, looking left" in file.pages.first.description
    sheets = [contact_sheet(images[:1], [TURNED[k]], grid, look) for k in (0, 1, 3)]
    heights = [Image.open(io.BytesIO(png)).height for png in sheets]
    assert heights[0] < heights[1] < heights[2]  # a line for each
    told = [frame(images[0], view, grid, look, unusual=True) for view in TURNED]
    assert len({one.shape for one in told}) == 1
    line = [one[-20:].astype(int) for one in told]
    assert not line[0].any()
    assert all(np.abs(line[k] - line[j]).max() > 50 for k in range(1, 6) for j in range(k))
    Rendered(images, TURNED, grid, look).write(tmp_path / "all.gif", seconds=1, overwrite=False)
    with Image.open(tmp_path / "all.gif") as animation:
        assert animation.height == len(told[0]) == len(frame(images[0], TURNED[0], grid, look)) + 20


@pytest.mark.parametrize("spacing_m", [0.01, 4.0])
def test_sheets_have_a_scale_bar_as_long_as_it_says(spacing_m: float) -> None:
    grid = ImageGrid(32, 48, spacing_m=(spacing_m, spacing_m), resolution_m=(spacing_m, spacing_m))
    dark = dataset_of(grid, [(View(20.0, 30.0), "train")], np.full((1, 32, 48), 1e-9, np.float32))
    dark.power[0, [2, 27, 16, 16], [24, 24, 0, 47]] = 1.0  # more than 0.1 %, and as far apart as the image is wide
    share, _ = scale_bar(48 * spacing_m)
    for png in (contact_sheet(dark.power, dark.views, grid, Look(1.0)), check_sheet(dark)):
        sheet = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), int)
        black = (sheet == 0).all(axis=2)
        rows = np.flatnonzero(black.sum(axis=1) > 0.4 * black.sum(axis=1).max())
        panel = np.ptp(np.flatnonzero(black[rows[0]])) + 1
        lower = slice(rows[0] + 9 * len(rows) // 10, rows[-1])  # below all words
        bar = max((sheet[lower] > 200).all(axis=2).sum(axis=1))
        assert bar / panel == pytest.approx(share, abs=3 / panel)


def test_one_corner_reflector_does_not_darken_a_check() -> None:
    grid = ImageGrid(64, 64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
    images = np.full((1, 64, 64), 1e-9, np.float32)
    images[0, 16:48, 16:48] = 1.0
    images[0, 5, 5] = 1e4  # 40 dB above the rest
    data = dataset_of(grid, [(View(20.0, 30.0), "train")], images)
    assert (np.asarray(Image.open(io.BytesIO(check_sheet(data))).convert("L")) > 250).mean() > 0.05


def test_a_contact_sheet_is_as_bright_as_the_single_pictures_and_capped(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SarsplatError, match="no images"):
        contact_sheet(np.empty((0, 16, 16)), [], ImageGrid(16, 16, (0.3, 0.3), (0.3, 0.3)), Look(1.0))
    assert sheet._MOST == 96  # as its documentation says; twelve lines take a second to draw
    monkeypatch.setattr(sheet, "_MOST", 8)
    grid = ImageGrid(24, 24, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
    images, views = np.full((72, 24, 24), 1.0), [View(5.0 * k, 30.0) for k in range(72)]
    picture = Image.open(io.BytesIO(contact_sheet(images, views, grid, Look(100.0))))
    assert picture.height < 1000  # and not nine lines
    grey = np.asarray(picture.convert("L"))
    assert (grey == 128).mean() > 0.4  # half of 40 dB below white, as in the PNGs


@pytest.mark.parametrize("size", [1, 3])
def test_the_nearest_point_of_a_pixel_is_seen_the_last_of_equals(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr("sarsplat.report.boards._BATCH", 64)
    points = np.random.default_rng(0).integers(-1, 11, (500, 3)).astype(float)  # on a lattice, some of them outside
    raster = Raster(np.zeros(3), np.full(3, 10.0), 1.0)
    for side, seen in zip(SIDES, raster.sides(points, size), strict=True):
        painted = np.full((12 + size, 12 + size), -1)
        for point in np.argsort(side.sign * points[:, side.towards], kind="stable"):
            up, across = (int(points[point, axis]) + 1 for axis in (side.up, side.across))
            painted[up : up + size, across : across + size] = point
        first = 1 + size // 2
        np.testing.assert_array_equal(seen, painted[first : first + 10, first : first + 10][::-1])


# ---- stacks ----------------------------------------------------------------------------------------------------------
VIEW, GRID = View(0.0, 45.0), ImageGrid(24, 20, (0.5, 0.6), (0.6, 0.6))
OFFSETS = (0.0, 0.0006, 0.0012, 0.0024, 0.0048)
STACK = Stack(0.031, OFFSETS, noise=(0.05,) * 5)


BLOCK = trimesh.creation.box((4.0, 6.0, 5.0)).apply_translation((0.0, 0.0, 2.5))


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Of the block."""
    law = ScatteringLaw(floor=1.0, lobe=0.0, exponent=1.0)
    signal = simulate_stack(BLOCK, VIEW, GRID, STACK, law, ground_gamma0=0.5, noise=0.05)
    return dataset_of(GRID, [(VIEW, "train")], signal[None], stack=STACK, looks=1.0, ground=True, target="block")


@pytest.mark.parametrize("height_m", [3.0, 8.0, 20.0, 1000.0])
def test_the_pair_is_the_longest_whose_phase_turns_at_most_once(height_m: float) -> None:
    pair = Pair.longest(STACK, VIEW, height_m)
    assert OFFSETS[pair.first] > OFFSETS[pair.second]  # what is higher has more phase
    cycle_m = 0.5**0.5 * 0.031 / 2 / (OFFSETS[pair.first] - OFFSETS[pair.second])
    assert pair.cycle_m == pytest.approx(cycle_m, rel=1e-4)
    baselines = sorted({round(a - b, 6) for a in OFFSETS for b in OFFSETS if a > b})
    at_most = 0.5**0.5 * 0.031 / 2 / height_m
    longest = max((one for one in baselines if one <= at_most), default=baselines[0])
    assert OFFSETS[pair.first] - OFFSETS[pair.second] == pytest.approx(longest)


@pytest.mark.parametrize("height_m", [-1.0, 0.0, 2.5])
def test_a_plane_is_coherent_and_its_phase_is_that_of_its_height(height_m: float) -> None:
    """Up to the edges."""
    pair = Pair.longest(STACK, VIEW, 6.0)
    rng = np.random.default_rng(0)
    speckle = rng.normal(size=(24, 20)) + 1j * rng.normal(size=(24, 20))
    signals = speckle * np.exp(1j * STACK.plane_phases(VIEW, GRID, height_m))
    shown = Interferogram.of(averaged(pair.of(covariances(signals), STACK.plane_phases(VIEW, GRID)), 3))
    np.testing.assert_allclose(shown.coherence, 1.0, rtol=1e-6)
    np.testing.assert_allclose(shown.phase, 2 * math.pi * height_m / pair.cycle_m, atol=1e-3)


def test_what_is_not_coherent_looks_so() -> None:
    rng = np.random.default_rng(0)
    signals = rng.normal(size=(5, 24, 20)) + 1j * rng.normal(size=(5, 24, 20))
    parts = Pair(1, 0, 10.0).of(covariances(signals), np.zeros((5, 24, 20)))
    assert Interferogram.of(averaged(parts, 3)).coherence.mean() < 0.4
    assert Interferogram.of(averaged(parts, 11)).coherence.mean() < 0.15
    assert not Interferogram.of(0 * parts).coherence.any()


def test_the_slice_is_where_layover_is_bright() -> None:
    """Not where power is brightest: there, all points of a pixel have one height."""
    signals = np.ones((2, 5, 24, 20), np.complex64)
    signals[..., 3], signals[1, ..., 14] = 10.0, 3.0
    images = dataset_of(GRID, [(View(90.0, 45.0), "train"), (VIEW, "train")], signals, stack=STACK, looks=1.0)
    wall = [(GRID.azimuth_m[c], e, 0.0) for c in (7, 14) for e in (0.0, 1.1 * STACK.resolution_m)]
    ground = [(azimuth, 0.0, 1.0) for azimuth in GRID.azimuth_m]
    index, cut = brightest_layover(images, np.array(wall + ground) @ radar_frame(VIEW), 3)
    assert (index, cut.view) == (1, VIEW)
    assert abs(cut.azimuth_m - GRID.azimuth_m[14]) < 1.1 * 0.5  # the window of three columns holds it
    assert cut.thickness_m == pytest.approx(1.5)
    _, none = brightest_layover(images, np.array(ground) @ radar_frame(VIEW), 3)
    assert abs(none.azimuth_m - GRID.azimuth_m[3]) < 1.1 * 0.5


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 215.0])
def test_a_slice_lies_along_the_line_of_sight(azimuth: float) -> None:
    view = View(azimuth, 30.0)
    cut = Slice(view, 2.0, 1.0)
    local = np.array([[2.0, 0.0, 0.0], [2.4, 3.0, 0.0], [2.6, 3.0, 0.0], [2.0, 0.0, 4.0]])
    points = local @ radar_frame(view)
    assert cut.within(points).tolist() == [True, True, False, True]
    ranges, heights = cut.axes(points)
    assert ranges[3] - ranges[0] == pytest.approx(4 * math.cos(math.radians(30)))  # farther away
    assert heights[3] - heights[0] == pytest.approx(-2.0)
    lines = cut.through(trimesh.creation.box((50.0, 50.0, 2.0)))
    np.testing.assert_allclose(lines @ radar_frame(view)[0], 2.0, atol=1e-9)
    assert np.abs(lines[..., 2]).max() == pytest.approx(1.0)


def test_the_page_shows_phase_coherence_and_a_slice(dataset: Dataset, tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", dataset, truth_mesh=BLOCK)
    run = reconstruct(data, replace(preset("stack"), iterations=3), quiet=True)
    text = re.sub(r"base64,[A-Za-z0-9+/=]+", "", write_report(run, tmp_path / "page.html", quiet=True).read_text())
    for words in (
        *("<h2>Phase and coherence</h2>", "<h2>Slice through the layover</h2>", "mean of all 5 passes"),
        *("true surface", "m of height", "ground range, m</span>", "height z, m</span>", "Capon&#39;s method, "),
    ):
        assert words in text, words
    for name in ("measured", "rendered"):
        for what in ("power", "phase", "coherence"):
            assert f'alt="{name}: {what}"' in text
    assert text.count('class="outline true"') >= 2 * 4  # a box, beside both clouds
    pictures = text[text.index("Phase and coherence") : text.index("Slice through")]
    assert pictures.count('class="line second"') == 1  # where it is cut


@pytest.mark.filterwarnings("ignore:there is one training view")
def test_the_page_of_a_run_of_power_alone_shows_neither(dataset: Dataset, tmp_path: Path) -> None:
    few = preset("speckled")
    few = replace(few, iterations=1, fewest_gaussians=10, points=replace(few.points, rays_per_pixel=1.0))
    run = reconstruct(dataset, few, quiet=True)
    text = write_report(run, tmp_path / "page.html", quiet=True).read_text()
    assert "Phase and coherence" not in text and "Slice through" not in text
