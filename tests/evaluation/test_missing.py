"""Objects that images show and points lack."""

from dataclasses import replace

import numpy as np
import torch

from made import FEW_POINTS, dataset_of
from sarsplat import Gaussians, Harmonics, ImageGrid, Run, View, render
from sarsplat.evaluation.left_open import _middles, missing
from sarsplat.runs.run_folder import left_open

GRID = ImageGrid(64, 48, (0.25, 0.3), (0.25, 0.3))
VIEWS = [View(azimuth, grazing) for grazing in (35.0, 50.0) for azimuth in range(0, 360, 40)]
BALLS = torch.tensor([[-3.0, 0.0, 1.0], [3.0, 1.0, 2.0]])


def test_an_object_without_points_is_named_where_it_stands() -> None:
    gaussians = Gaussians(
        means=BALLS,
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.4),
        optical_depth=torch.full((2,), 3.0),
        scattering=Harmonics(torch.tensor([[1.0], [0.5]])),
    )
    images = render(gaussians, VIEWS, GRID).channel(0).numpy()
    speckled = images * np.random.default_rng(0).gamma(4.0, 0.25, images.shape).astype(np.float32)
    run = Run.from_gaussians(gaussians, dataset=dataset_of(GRID, [(view, "train") for view in VIEWS], speckled))
    run = replace(run, config=replace(run.config, points=FEW_POINTS))
    assert len(missing(run)) == 0
    vars(run)["points"] = run.points[run.points[:, 0] < 0]
    places = missing(run)
    assert len(places) == 1 and np.linalg.norm(places[0] - BALLS[1].numpy()) < 1.0
    assert "1 place" in left_open({"missing": places.tolist()})["missing"]


def test_patches_connected_at_half_the_level_are_one_object() -> None:
    excess_db = np.zeros((3, 9, 20))
    excess_db[1, 4, 2:9] = 2.0
    excess_db[1, 4, [2, 8]] = 4.0
    excess_db[1, 4, 14] = 5.0
    excess_db[1, 7, 14:18] = 2.5  # faint everywhere
    assert _middles(excess_db, 3.0).tolist() == [[1, 4, 14], [1, 4, 5]]
    assert _middles(excess_db, 6.0).shape == (0, 3)
