"""Pictures: decibels, windows, sheets."""

import io

import numpy as np
import pytest
from PIL import Image

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.reconstruction.log import LogLine
from sarsplat.report import Look, contact_sheet, decibel_png
from sarsplat.report.curves import curves_figure
from sarsplat.report.decibels import to_decibels
from sarsplat.report.views import _difference_db, evenly
from sarsplat.report.window import target_window


def test_decibels_of_power() -> None:
    np.testing.assert_allclose(to_decibels(np.array([1.0, 10.0, 0.5]), peak=10.0), [-10, 0, -13.0103], atol=1e-4)
    assert np.isfinite(to_decibels(0.0))


def test_grey_levels_of_the_png() -> None:
    power = np.array([[100.0, 1.0], [0.01, 0.0]])  # 0, −20, −40 dB and nothing
    picture = Image.open(io.BytesIO(decibel_png(power, Look(100.0))))
    assert np.asarray(picture).tolist() == [[255, 128], [0, 0]]
    assert "-40 dB" in picture.text["Description"]


@pytest.mark.parametrize("losses", [(-1e30, 1e30), (1e-320, 1e30), (0.0, 0.0), (1e30, 1e30)])
@pytest.mark.parametrize("counts", [(0, 0), (0, 10**9), (10**9, 10**9)])
def test_curves_of_whatever_a_history_may_hold(losses: tuple[float, float], counts: tuple[int, int]) -> None:
    history = [LogLine(n, 0.0, loss, n) for loss, n in zip(losses, counts, strict=True)]
    assert curves_figure(history, "loss").startswith(b"\x89PNG")


@pytest.mark.parametrize(("count", "wanted", "expected"), [(48, 3, [0, 24, 47]), (2, 6, [0, 1]), (1, 6, [0])])
def test_views_are_chosen_evenly(count: int, wanted: int, expected: list[int]) -> None:
    assert evenly(count, wanted) == expected


def test_the_window_holds_every_bright_pixel() -> None:
    truth = np.zeros((2, 64, 64))
    truth[0, 30, 20], truth[1, 40, 35] = 1.0, 1.0
    rows, columns = target_window(truth, peak=1.0)
    assert (truth[:, rows, columns] > 0).sum() == 2
    assert rows.stop - rows.start == columns.stop - columns.start < 40


def test_the_difference_ignores_what_is_too_dark_to_see() -> None:
    truth, rendered = np.array([[1.0, 1e-9]]), np.array([[2.0, 1e-7]])
    np.testing.assert_allclose(_difference_db(truth, rendered, 1.0, False), [[3.0103, 0]], atol=1e-4)


@pytest.mark.parametrize("count", [1, 7])
def test_a_contact_sheet_of_any_length(count: int) -> None:
    grid = ImageGrid(16, 24, spacing_m=(0.3, 0.2), resolution_m=(0.3, 0.3))
    views = [View(10.0 * k, 30.0) for k in range(count)]
    sheet = Image.open(io.BytesIO(contact_sheet(np.ones((count, 16, 24)), views, grid, Look(1.0))))
    assert min(sheet.size) > 100


def test_a_contact_sheet_shows_the_target_large() -> None:
    grid = ImageGrid(128, 128, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
    images = np.zeros((6, 128, 128))
    images[:, 60:68, 60:68] = 1.0  # 0.4 % of the image
    views = [View(60.0 * k, 30.0) for k in range(6)]
    sheet = np.asarray(Image.open(io.BytesIO(contact_sheet(images, views, grid, Look(1.0)))).convert("L"))
    assert (sheet > 250).mean() > 0.08


def test_minor_ticks_can_be_read_on_the_dark_panel() -> None:
    from matplotlib.colors import to_hex

    from sarsplat.report.canvas import MUTED, dress, new_figure

    figure = new_figure(4, 3)
    axes = figure.subplots()
    axes.plot([1, 2], [2.0, 9.0])
    axes.set_yscale("log")
    dress(axes)
    figure.canvas.draw()
    labels = [label for label in axes.get_yticklabels(minor=True) if label.get_text()]
    assert labels
    assert {to_hex(label.get_color()) for label in labels} == {MUTED}


def test_a_contact_sheet_of_nothing_is_refused() -> None:
    grid = ImageGrid(16, 16, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
    with pytest.raises(SarsplatError, match="no images"):
        contact_sheet(np.empty((0, 16, 16)), [], grid, Look(1.0))
