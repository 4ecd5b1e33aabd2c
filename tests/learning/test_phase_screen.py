"""What atmosphere adds to the phases of passes is learned beside the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from test_stacks import GRID, VIEW, dataset

from sarsplat import preset, reconstruct
from sarsplat.data import Dataset
from sarsplat.learning.model import SceneModel


def screened(constants: np.ndarray, slopes: np.ndarray) -> Dataset:
    """A block's stack, with phases that are constant and those that rise from the near to the far edge, rad."""
    clear = dataset()
    down = np.linspace(-1, 1, GRID.rows)[:, None]
    turned = np.exp(1j * (constants[:, None, None] + slopes[:, None, None] * down))
    return Dataset.of_complex(GRID, clear.entries, clear.signal * turned, looks=1.0, ground=True, target="block")


def without_heights(phases: np.ndarray) -> np.ndarray:
    """What is left of the phases of passes when heights have explained what they can."""
    numbers = np.stack([dataset().stacks[0].elevation_numbers(VIEW), np.ones(len(phases))], axis=1)
    return phases - numbers @ np.linalg.lstsq(numbers, phases, rcond=None)[0]


def test_screens_are_found():
    constants = np.array([0.0, 0.9, -0.7, 0.5, -0.9, 0.3])
    slopes = np.array([0.0, 0.3, -0.4, 0.4, 0.0, -0.3])
    data = screened(constants, slopes)
    config = replace(preset("stack"), iterations=120, gaussians=1500)
    learned = reconstruct(data, replace(config, passes=replace(config.passes, screen_std=0.7)), quiet=True)
    found = learned.snapshot.tensors["model/phase_screen"].numpy().reshape(6, 3)
    assert np.abs(without_heights(found[:, 0]) - without_heights(constants)).max() < 0.2
    assert np.abs(without_heights(found[:, 2]) - without_heights(slopes)).max() < 0.25
    assert np.abs(without_heights(found[:, 1])).max() < 0.2
    untold = reconstruct(data, config, quiet=True)
    assert "model/phase_screen" not in untold.snapshot.tensors
    assert learned.history[-1].loss < untold.history[-1].loss - 0.3


def test_gradients_and_unseen_images():
    data, config = screened(np.zeros(6), np.zeros(6)), preset("stack")
    config = replace(config, gaussians=60, passes=replace(config.passes, screen_std=0.7))
    model = SceneModel.initial(config, data, torch.Generator().manual_seed(0))
    screen = model.parameters["phase_screen"]
    with torch.no_grad():
        screen += 0.3 * torch.randn(screen.shape, generator=torch.Generator().manual_seed(1))
    (part,) = [part for part in model.parts if type(part).__name__ == "PhaseScreen"]
    shot = model.shot([VIEW], GRID, torch.tensor([0]))
    double = screen.detach().double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: part.phases(shot, {"phase_screen": p}), double)
    constant, along, away = screen.detach()[0].unflatten(0, (-1, 3)).unbind(-1)
    phases = part.phases(shot, {"phase_screen": screen.detach()})[0]
    torch.testing.assert_close(phases[:, 0, -1], constant + along - away)  # near range is row 0
    torch.testing.assert_close(phases.mean((1, 2)), constant, atol=1e-5, rtol=0)
    assert part.phases(model.shot([VIEW], GRID), {"phase_screen": double}) is None
