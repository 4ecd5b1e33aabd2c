"""The named benchmark scene: a recipe from a seed, never a file."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from scene import Scene

from sarsplat.gaussians.initialise import Region, random_quaternions
from sarsplat.learning.model import SceneModel
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.scenes import paper_grid, paper_views
from sarsplat.settings.presets import preset

COUNT = 15_000


def halfway(count: int = COUNT) -> SceneModel:
    """The distributions of a T-72 run's Gaussians halfway through, with harmonics and all in place from the start."""
    generator = torch.Generator().manual_seed(0)
    region = Region.box((-3.4, -1.78, 0.1), (5.2, 1.78, 2.15))
    medians = torch.tensor([0.025, 0.053, 0.083])  # m, shortest to longest axis
    log_scales = medians.log() + torch.tensor([0.6, 0.5, 0.6]) * torch.randn(count, 3, generator=generator)
    log_depth = math.log(0.18) + 2.1 * torch.randn(count, generator=generator)
    parameters = {
        "means": torch.from_numpy(region.sample(count, generator)).float(),
        "quaternions": random_quaternions(count, generator),
        "scales": log_scales.exp().clamp(0.01, 0.3),
        "optical_depth": log_depth.exp().clamp(1e-3, 10.0),
        "scattering": torch.cat(
            [
                -2.6 + 2.2 * torch.randn(count, 1, generator=generator),
                0.22 * torch.randn(count, 15, generator=generator),
            ],
            dim=1,
        ),
    }
    config = replace(preset("default"), scattering="harmonics")
    return SceneModel(
        config, SceneFrame(region, 1.0, tuple(view for view, _ in paper_views()), paper_grid()), parameters
    )


def training_view(count: int = COUNT) -> Scene:
    """The halfway Gaussians in one view of the training set."""
    return Scene(halfway(count).target(3), (paper_views()[24][0],), paper_grid())
