"""A loss of your own: compare decibels instead of amplitudes, so that faint parts count as much as bright ones."""

from dataclasses import replace

import torch

from sarsplat import Dataset, ImageGrid, SarImage, View, preset, reconstruct, simulate_images, target_mesh

FLOOR = 1e-3  # β⁰, linear power: what is darker counts as equally dark


def decibels(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference, dB, of two stacks [V, rows, columns] of β⁰."""
    return 10 * (torch.log10(rendered + FLOOR) - torch.log10(truth + FLOOR)).abs().mean()


grid = ImageGrid(rows=64, columns=64, spacing_m=(0.3, 0.3), resolution_m=(0.3, 0.3))
views = [View(azimuth, 45.0) for azimuth in range(0, 360, 45)]
arrays = simulate_images(target_mesh("t72"), views, grid)
dataset = Dataset.from_images([SarImage(power, view, grid) for power, view in zip(arrays, views)])
settings = replace(preset("default"), iterations=120, gaussians=3000)

for loss in (None, decibels):  # None: the preset's own
    run = reconstruct(dataset, settings, loss=loss, quiet=True)
    rendered, truth = (torch.as_tensor(images) for images in (run.render(dataset.views), dataset.power))
    print(f"trained on {run.config.loss}: {decibels(rendered, truth):.3f} dB off")
