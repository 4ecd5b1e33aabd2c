"""One image in memory: what it takes, and its amplitude and decibels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from sarsplat.data import SarImage
from sarsplat.data.picture import _draw
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View

GRID = ImageGrid(2, 3, (0.3, 0.3), (0.3, 0.3))
VIEW = View(0, 30)


def test_amplitude_and_decibels() -> None:
    power = np.array([[100, 1, 0], [4, 0.01, 1e-45]], np.float32)
    image = SarImage(power, VIEW, GRID)
    np.testing.assert_allclose(image.amplitude[0], [10, 1, 0])
    np.testing.assert_allclose(image.db()[0], [20, 0, -np.inf])


def test_an_image_of_the_renderer_is_taken_as_it_is() -> None:
    power = torch.ones(2, 3, requires_grad=True) * 2
    assert SarImage(power, VIEW, GRID).power.tolist() == [[2.0, 2, 2], [2, 2, 2]]


def test_a_picture_has_metres_and_decibels(tmp_path: Path) -> None:
    Image = pytest.importorskip("PIL.Image")
    grid = ImageGrid(20, 40, (0.5, 0.25), (0.5, 0.25))
    power = np.full((20, 40), 1e-3)
    power[4, 30] = 100.0
    image = SarImage(power, View(30, 40), grid)
    image.save(tmp_path / "picture.png")
    with Image.open(tmp_path / "picture.png") as picture:
        shades = np.asarray(picture.convert("L"))
    assert min(shades.shape) > 150
    assert image._repr_png_() == (tmp_path / "picture.png").read_bytes()
    figure = Figure()
    _draw(image.power, image.view, image.grid, figure, 40.0)
    axes, bar = figure.axes
    assert axes.get_images()[0].get_extent() == [-10.0, 10.0, 2.5, -2.5]  # near range on top
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("azimuth, m", "slant range, m")
    assert bar.get_ylim() == pytest.approx((-20.0, 20.0))


def test_black_images_and_wrong_names(tmp_path: Path) -> None:
    image = SarImage(np.zeros((2, 3)), VIEW, GRID)
    image.save(str(tmp_path / "black.png"))
    with pytest.raises(SarsplatError, match=r"does not end in \.png"):
        image.save(tmp_path / "image.tif")
    with pytest.raises(SarsplatError, match=r"dynamic range of 0\.0 dB"):
        image.save(tmp_path / "a.png", dynamic_range_db=0.0)


@pytest.mark.parametrize(
    ("power", "told"),
    [
        ([[1.0, 1, 1], [1, 1, 1]], "the image is of type list; give power as an array"),
        (np.ones((2, 3), complex), "the image is of type complex128; give power as .*SarImage.of_complex"),
        (np.ones((3, 2)), r"shape \(3, 2\) but its grid has \(2, 3\)"),
        (np.array([[1, 1, 1], [1, -1, 1.0]]), r"holds -1 at \(1, 1\)"),
        (np.array([[1, 1, 1], [1, 1, np.nan]]), "holds nan at \\(1, 2\\)"),
    ],
)
def test_what_is_no_power_is_refused(power: Any, told: str) -> None:
    with pytest.raises(SarsplatError, match=told):
        SarImage(power, VIEW, GRID)
