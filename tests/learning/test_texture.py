"""Parts of measured images: texture, found from some chips and seen in others, and side lobes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat import ImageGrid, View, radar_frame
from sarsplat.geometry.responses import TAYLOR, Taylor
from sarsplat.learning.parts.measured import with_side_lobes
from sarsplat.learning.parts.texture import Maps
from sarsplat.settings.sections import Surroundings

GRID = ImageGrid(48, 60, (0.4, 0.5), (0.6, 0.7), (1.0, -2.0))
SETTINGS = Surroundings(texture_looks=0.01, texture_reach_deg=20.0)
VIEWS = [View(azimuth, 30.0) for azimuth in range(0, 360, 10)]


def pattern(view: View, shift_m: np.ndarray) -> np.ndarray:
    """A waved ground as a chip shows it that is displaced."""
    pixels = np.stack(np.meshgrid(GRID.azimuth_m, GRID.range_m), axis=-1) - shift_m
    x, y = np.moveaxis(pixels @ np.linalg.inv(radar_frame(view)[[0, 2], :2]).T, -1, 0)
    return 1 + 0.5 * np.sin(x) * np.cos(0.7 * y + 1)


def chips(views: list[View], shifts_m: np.ndarray) -> dict[str, torch.Tensor]:
    ratio = np.stack([pattern(view, shift_m) for view, shift_m in zip(views, shifts_m, strict=True)])
    angles = torch.tensor([(view.azimuth_deg, view.grazing_deg) for view in views], dtype=torch.float64)
    return {"ratio": torch.from_numpy(ratio).float(), "shift_m": torch.from_numpy(shifts_m).float(), "view_deg": angles}


@pytest.mark.parametrize("grazing_deg", [30.0, 45.0])
def test_a_pattern_on_the_ground_is_seen_from_anywhere(grazing_deg: float) -> None:
    """An unseen chip is displaced as the mean one is."""
    shifts_m = np.random.default_rng(0).normal(size=(len(VIEWS), 2))
    texture = Maps(chips(VIEWS, shifts_m), GRID, SETTINGS)
    wanted = View(4.0, grazing_deg)
    inside = (slice(8, -8), slice(8, -8))
    found = texture.factor([wanted], GRID)[0].numpy()[inside]
    assert np.abs(found - pattern(wanted, shifts_m.mean(axis=0))[inside]).max() < 0.06
    own = texture.among_images[7].numpy()[inside]
    assert np.abs(own - pattern(VIEWS[7], shifts_m[7])[inside]).max() < 0.06


def test_a_chip_does_not_explain_itself() -> None:
    tensors = chips(VIEWS, np.zeros((len(VIEWS), 2)))
    changed = {**tensors, "ratio": tensors["ratio"].clone()}
    changed["ratio"][3] = 50.0
    before, after = (Maps(some, GRID, SETTINGS).among_images for some in (tensors, changed))
    assert torch.equal(before[3], after[3])
    assert float((after[4] / before[4]).median()) > 5


def test_few_looks_are_believed_less_and_distant_ones_not_at_all() -> None:
    settings = replace(SETTINGS, texture_looks=2.0)
    views, ratio = [View(350.0, 30.0)], torch.full((1, 48, 60), 4.0)
    texture = Maps.estimated(ratio, torch.zeros(1, 2), views, GRID, settings)
    near, farther, opposite = texture.factor([View(350.0, 45.0), View(10.0, 30.0), View(170.0, 30.0)], GRID)
    assert float(near[24, 30]) == pytest.approx((2 + 4) / (2 + 1))
    weight = np.exp(-1)  # 20° away
    assert float(farther[24, 30]) == pytest.approx((2 + 4 * weight) / (2 + weight), rel=1e-5)
    assert torch.equal(opposite, torch.ones(48, 60))


def test_the_ratio_is_smoothed_over_cells_and_not_over_chips() -> None:
    ratio = torch.full((2, 48, 60), 2.0)
    ratio[1, 20, 30] += 200
    settings = replace(SETTINGS, texture_width=0.5)
    ratio = Maps.estimated(ratio, torch.zeros(2, 2), VIEWS[:2], GRID, settings).tensors["ratio"]
    assert torch.allclose(ratio[0], torch.full((48, 60), 2.0))
    over = ratio[1].double() - 2
    assert float(over.sum()) == pytest.approx(200, rel=1e-3)
    offsets = np.arange(60) - 30
    spread_m = np.sqrt((over.sum(0).numpy() * offsets**2).sum() / 200) * GRID.spacing_m[0]
    assert spread_m == pytest.approx(0.5 * GRID.cell_m, rel=0.05)


def test_a_window_wider_than_the_image_takes_its_mean() -> None:
    """And no longer for it."""
    ratio = torch.zeros(1, 48, 60)
    ratio[0, 20, 30] = 48 * 60
    settings = replace(SETTINGS, texture_width=1e6)
    found = Maps.estimated(ratio, torch.zeros(1, 2), VIEWS[:1], GRID, settings).tensors["ratio"]
    assert torch.allclose(found, found[0, 0, 0].expand_as(found), rtol=0.2)


# ---- side lobes: where they lie, and how strong they are -------------------------------------------------------------
ODD = ImageGrid(81, 101, (0.1, 0.12), (0.3, 0.4))


def point() -> torch.Tensor:
    """The Gaussian response of one scatterer."""
    rows, columns = (
        np.exp(-4 * np.log(2) * (axis / width) ** 2)
        for axis, width in ((ODD.range_m, ODD.resolution_m[1]), (ODD.azimuth_m, ODD.resolution_m[0]))
    )
    return torch.from_numpy(np.outer(rows, columns))[None]


def test_they_are_35_db_down_and_fall_off() -> None:
    image = 10 * torch.log10(with_side_lobes(point(), torch.ones(2).double(), ODD)[0] + 1e-12).numpy()
    for cut, width, spacing in ((image[40, 50:], 0.3, 0.1), (image[40:, 50], 0.4, 0.12)):
        distance = np.arange(len(cut)) * spacing / width
        near, far = cut[(distance > 2) & (distance < 4)].max(), cut[distance > 8].max()
        assert -38.5 < near < -34  # the Gaussian response smooths them
        assert far < near - 4
    assert image[0, 0] < -70  # none off the row and the column


def test_their_level_is_theirs_alone_and_differentiable() -> None:
    images = torch.rand(2, 81, 101, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.equal(with_side_lobes(images, torch.zeros(2).double(), ODD), images)
    added = with_side_lobes(point(), torch.tensor([0.0, 3.0]).double(), ODD)[0] - point()[0]
    assert float(added[40, 70]) < 1e-3 * float(added[60, 50])
    level = torch.tensor([0.7, 1.3], dtype=torch.float64, requires_grad=True)
    small = ImageGrid(5, 4, ODD.spacing_m, ODD.resolution_m)
    part = images[:, :5, :4].detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda some, much: with_side_lobes(some, much, small), (part, level))


def test_they_are_those_of_the_grid_s_response():
    level = torch.ones(2).double()
    commonest = with_side_lobes(point(), level, ODD)
    assert torch.equal(with_side_lobes(point(), level, replace(ODD, response=TAYLOR)), commonest)
    lower = with_side_lobes(point(), level, replace(ODD, response=Taylor(45, 6)))
    near = float((lower - point())[0, 40, 60] / (commonest - point())[0, 40, 60])
    assert near < 0.3
