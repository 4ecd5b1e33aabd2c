"""The checker of shape annotations does check; otherwise every other test would pass in vain."""

from collections import Counter

import numpy as np
import pytest
import torch
from jaxtyping import Float

import shapes
from sarsplat import Gaussians, Harmonics, SarsplatError, View, radar_frame
from sarsplat.evaluation.lpips import Lpips
from sarsplat.gaussians.gaussians import covariance, rotation_matrix
from sarsplat.geometry.responses import GAUSSIAN
from sarsplat.renderer import covariances
from sarsplat.scenes._deposit import _Axis


@pytest.fixture(autouse=True)
def none_yet(monkeypatch):
    """However many calls earlier tests made."""
    monkeypatch.setattr(shapes, "EXECUTED", Counter())


def test_calls_are_counted_up_to_two_hundred():
    for _ in range(300):
        radar_frame(View(0.0, 45.0))
    assert shapes.EXECUTED["sarsplat.geometry.view.radar_frame"] == shapes.MOST
    assert View(0.0, 45.0).direction.shape == (3,)
    assert shapes.EXECUTED["sarsplat.geometry.view.View.direction"] > 0


def test_initialisers_and_calls_are_watched():
    with pytest.raises(shapes.ShapeError, match=r"_Axis\.__init__ accepted centers"):
        _Axis(np.zeros(3, np.float32), 0.1, 0.3, GAUSSIAN, 9)
    assert hasattr(Lpips.__call__, "__wrapped__")


@pytest.mark.parametrize("scales", [(1, 3), (5, 1), (3,)])
def test_a_function_that_takes_a_wrong_shape_is_found(scales):
    with pytest.raises(shapes.ShapeError, match=r"covariance accepted scales: not of the shape in its annotation"):
        covariance(torch.ones(5, 4), torch.ones(scales))


def test_a_wrong_result_is_found():
    def shrunk(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return points[1:]

    with pytest.raises(shapes.ShapeError, match="shrunk returned something else"):
        shapes.watched(shrunk)(np.zeros((4, 3)))


def test_refusing_by_itself_is_fine():
    with pytest.raises(SarsplatError, match=r"means has shape \(5, 2\)"):
        Gaussians(torch.ones(5, 2), torch.ones(5, 4), torch.ones(5, 3), torch.ones(5), Harmonics(torch.ones(5, 1)))


def test_names_imported_elsewhere_are_watched_too():
    assert covariances.rotation_matrix is rotation_matrix
    assert hasattr(rotation_matrix, "__wrapped__")
