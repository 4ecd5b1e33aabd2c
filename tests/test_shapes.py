"""The tests' own tools work: shape annotations are checked, and the browser tells of requests."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float

import shapes
from chromium import chromium
from sarsplat import View, radar_frame
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


def test_names_imported_elsewhere_are_watched_too():
    assert covariances.rotation_matrix is rotation_matrix
    assert hasattr(rotation_matrix, "__wrapped__")


# ---- the browser -----------------------------------------------------------------------------------------------------
PAGE = """
<img src="http://elsewhere.invalid/picture.png">
<script>
const ask = "fetch('http://elsewhere.invalid/worker').catch(() => 0).finally(() => postMessage('asked'))"
new Worker(URL.createObjectURL(new Blob([ask]))).onmessage = () => window.asked = true
new WebSocket("ws://elsewhere.invalid/socket")
</script>
"""


def test_the_requests_of_a_page_and_of_its_workers_are_seen(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(PAGE, encoding="utf-8")
    with chromium() as browser:
        browser.page.open((tmp_path / "page.html").as_uri())
        browser.page.until("window.asked === true")
        told = [complaint["entry"]["url"] for complaint in browser.page.complaints if "entry" in complaint]
        asked = browser.quit()
    assert "http://elsewhere.invalid/picture.png" in told
    assert sorted(asked) == [
        "http://elsewhere.invalid/picture.png",
        "http://elsewhere.invalid/worker",
        "ws://elsewhere.invalid/socket",
    ]
