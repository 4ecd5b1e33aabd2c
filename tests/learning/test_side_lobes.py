"""Side lobes: where they lie, and how strong they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sarsplat import ImageGrid
from sarsplat.geometry.responses import TAYLOR, Taylor
from sarsplat.learning.parts.measured import with_side_lobes

GRID = ImageGrid(81, 101, (0.1, 0.12), (0.3, 0.4))


def point() -> torch.Tensor:
    """The Gaussian response of one scatterer."""
    rows, columns = (
        np.exp(-4 * np.log(2) * (axis / width) ** 2)
        for axis, width in ((GRID.range_m, GRID.resolution_m[1]), (GRID.azimuth_m, GRID.resolution_m[0]))
    )
    return torch.from_numpy(np.outer(rows, columns))[None]


def test_they_are_35_db_down_and_fall_off() -> None:
    image = 10 * torch.log10(with_side_lobes(point(), torch.ones(2).double(), GRID)[0] + 1e-12).numpy()
    for cut, width, spacing in ((image[40, 50:], 0.3, 0.1), (image[40:, 50], 0.4, 0.12)):
        distance = np.arange(len(cut)) * spacing / width
        near, far = cut[(distance > 2) & (distance < 4)].max(), cut[distance > 8].max()
        assert -38.5 < near < -34  # the Gaussian response smooths them
        assert far < near - 4
    assert image[0, 0] < -70  # none off the row and the column


def test_their_level_is_theirs_alone_and_differentiable() -> None:
    images = torch.rand(2, 81, 101, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.equal(with_side_lobes(images, torch.zeros(2).double(), GRID), images)
    added = with_side_lobes(point(), torch.tensor([0.0, 3.0]).double(), GRID)[0] - point()[0]
    assert float(added[40, 70]) < 1e-3 * float(added[60, 50])
    level = torch.tensor([0.7, 1.3], dtype=torch.float64, requires_grad=True)
    small = ImageGrid(5, 4, GRID.spacing_m, GRID.resolution_m)
    assert torch.autograd.gradcheck(
        lambda some, much: with_side_lobes(some, much, small), (images[:, :5, :4].detach().requires_grad_(), level)
    )


def test_they_are_those_of_the_grid_s_response():
    level = torch.ones(2).double()
    commonest = with_side_lobes(point(), level, GRID)
    assert torch.equal(with_side_lobes(point(), level, replace(GRID, response=TAYLOR)), commonest)
    lower = with_side_lobes(point(), level, replace(GRID, response=Taylor(45, 6)))
    near = float((lower - point())[0, 40, 60] / (commonest - point())[0, 40, 60])
    assert near < 0.3
