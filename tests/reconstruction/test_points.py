"""Which of the returns that rays have become points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat import Gaussians, Harmonics, ImageGrid, View
from sarsplat.reconstruction import extract_points
from sarsplat.reconstruction.config import PointExtraction
from sarsplat.reconstruction.points import _FirstReturns, between

GRID = ImageGrid(32, 32, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(45.0 * k, 30.0) for k in range(8)]
HEIGHT, RADIUS = 1.5, 1.2
KEPT = PointExtraction(rays_per_pixel=4.0, seen_through=0.25)


@pytest.fixture(scope="module")
def ball_with_a_hole() -> Gaussians:
    """An opaque shell; through a hole in it the first view alone sees what is at its centre."""
    turns = np.arange(1500)
    z = 1 - 2 * (turns + 0.5) / len(turns)
    angle = turns * np.pi * (3 - 5**0.5)
    outwards = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    shell = RADIUS * outwards[outwards @ VIEWS[0].direction < np.cos(np.radians(15))]
    means = np.concatenate([shell, np.zeros((1, 3))])
    means[:, 2] += HEIGHT
    count = len(means)
    return Gaussians(
        torch.tensor(means, dtype=torch.float32),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.06),
        torch.full((count,), 6.0),
        Harmonics(torch.ones(count, 1)),
    )


def near_centre(points: np.ndarray) -> int:
    return int(np.sum(np.linalg.norm(points - [0, 0, HEIGHT], axis=1) < 0.4))


def test_what_one_view_alone_sees_is_left_out_if_others_must_see_it(ball_with_a_hole: Gaussians) -> None:
    all_points = extract_points(ball_with_a_hole, VIEWS, GRID, KEPT)
    assert near_centre(all_points) > 0
    points = extract_points(ball_with_a_hole, VIEWS, GRID, replace(KEPT, seen_by=3))
    assert near_centre(points) == 0
    assert len(points) > 0.8 * len(all_points)  # the shell, each part of which faces several views
    assert np.allclose(np.linalg.norm(points - [0, 0, HEIGHT], axis=1), RADIUS, atol=0.3)


def test_of_few_views_a_fifth_is_enough(ball_with_a_hole: Gaussians) -> None:
    views = VIEWS[::4]  # opposite ones, which see nothing in common
    usual = extract_points(ball_with_a_hole, views, GRID, KEPT)
    assert len(usual) > 0
    assert np.array_equal(extract_points(ball_with_a_hole, views, GRID, replace(KEPT, seen_by=3)), usual)


def test_views_between_neighbours_alone() -> None:
    ring = [View(azimuth, 30.0) for azimuth in (0.0, 90.0, 180.0, 270.0)]
    grazing = np.degrees(np.arctan(np.tan(np.radians(30)) / np.cos(np.radians(45))))
    actual = sorted((view.azimuth_deg, view.grazing_deg) for view in between([*ring, ring[0]]))
    assert actual == [pytest.approx((azimuth, grazing)) for azimuth in (45, 135, 225, 315)]  # opposite ones see others
    assert between(ring[:1]) == []


def test_how_far_behind_a_place_its_ray_returns() -> None:
    ranges = np.array([[1.0, 2.0, np.nan], [4.0, 5.0, 6.0]])  # two rows of y, three columns of x
    returns = _FirstReturns(np.eye(3), ranges, np.array([10.0, 20.0]), np.array([0.5, 2.0]))
    beyond = {(10, 20): 1, (10.5, 20): 2, (11, 20): np.inf, (11.2, 22.9): 6, (10.2, 21.1): 4}
    beyond |= dict.fromkeys([(9.7, 20), (11.3, 20), (10, 18.9), (10, 23.1)], np.inf)
    places = np.array([(*place, 0.25) for place in beyond])
    assert returns.beyond(places).tolist() == [far - 0.25 for far in beyond.values()]
    x, y, r = returns.points().T
    assert [*zip(x, y, r)] == [(10, 20, 1), (10.5, 20, 2), (10, 22, 4), (10.5, 22, 5), (11, 22, 6)]
