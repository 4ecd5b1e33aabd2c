"""Ground as a sheet of Gaussians: opaque alike everywhere, and as large as the images need it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sarsplat.errors import SarsplatError
from sarsplat.gaussians.ground import ground_radius_m, ground_sheet
from sarsplat.geometry import ImageGrid, View, radar_frame


def test_the_sheet_is_evenly_opaque_up_to_its_edge():
    sheet, pitch = ground_sheet(5.0, 0.4), 0.4
    assert len(sheet) == pytest.approx(math.pi * 5.0**2 / pitch**2, rel=0.02)
    assert not sheet.means[:, 2].any()
    assert sheet.means.norm(dim=1).max() < 5.0
    places = np.random.default_rng(0).uniform(-2, 2, (200, 1, 2))
    squared = ((places - sheet.means[:, :2].double().numpy()) ** 2).sum(axis=2)
    width = float(sheet.scales[0, 0])
    depth = (sheet.optical_depth.double().numpy() * np.exp(-squared / (2 * width**2))).sum(axis=1)
    np.testing.assert_allclose(depth, 2 * math.pi * 0.6**2 * 3, rtol=4e-3)  # seen from above, as from anywhere


def test_a_sheet_twice_as_large_is_the_same_twice_as_large():
    small, large = ground_sheet(3.0, 0.25), ground_sheet(6.0, 0.5)
    torch.testing.assert_close(large.means, 2 * small.means)
    torch.testing.assert_close(large.scales, 2 * small.scales)
    assert float(small.scales[:, 2].max()) < 0.05 * 0.25  # flat
    assert torch.equal(large.optical_depth, small.optical_depth)


@pytest.mark.parametrize("view", [View(0, 30), View(75, 60)])
def test_the_ground_reaches_past_the_farthest_corner_of_the_images(view):
    grid = ImageGrid(40, 30, (0.3, 0.2), (0.5, 0.4), (2.0, -1.5))
    to_ground = np.linalg.inv(radar_frame(view)[[0, 2], :2])
    edges = [axis[[0, -1]] + np.array([-0.5, 0.5]) * step
             for axis, step in zip((grid.azimuth_m, grid.range_m), grid.spacing_m, strict=True)]  # fmt: skip
    corners = to_ground @ np.stack(np.meshgrid(*edges)).reshape(2, -1)
    farthest = np.linalg.norm(corners, axis=0).max()
    assert ground_radius_m([view], grid) == pytest.approx(farthest + 2 * 0.5)
    assert ground_radius_m([view, View(10, 80)], grid) == pytest.approx(ground_radius_m([View(10, 80)], grid))


def test_too_few_and_too_many_gaussians_are_refused():
    with pytest.raises(SarsplatError, match=r"0\.5 m apart are too few for a ground of 0\.4 m radius"):
        ground_sheet(0.4, 0.5)
    with pytest.raises(SarsplatError, match="its radius may be at most 250 m"):
        ground_sheet(250.1, 0.1)
