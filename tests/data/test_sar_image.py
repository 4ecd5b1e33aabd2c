"""One image in memory: what it takes, and its amplitude and decibels."""

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from sarsplat.data import SarImage
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
    image._draw(figure, 40.0)
    axes, bar = figure.axes
    assert axes.get_images()[0].get_extent() == [-10.0, 10.0, 2.5, -2.5]  # near range on top
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("azimuth, m", "slant range, m")
    assert bar.get_ylim() == pytest.approx((-20.0, 20.0))


def test_black_images_are_pictures(tmp_path: Path) -> None:
    SarImage(np.zeros((2, 3)), VIEW, GRID).save(str(tmp_path / "black.png"))
    assert (tmp_path / "black.png").stat().st_size > 1000
