"""The images that a training learns from, on its device."""

from __future__ import annotations

import torch

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError

_FAINTEST = 1e-30
"""Largest β⁰ below which images count as black: squares and reciprocals of it would leave float32."""


class TrainingImages:
    """A dataset's training images.

    Parameters
    ----------
    dataset : Dataset
        All images.
    device : torch.device
        Where to keep them.

    Attributes
    ----------
    views : tuple of View
        From where they were taken, as refined so far.
    grid : ImageGrid
        Of the images.
    truth : Tensor, float32 [K, rows, columns]
        β⁰, linear power.
    numbers : Tensor, int64 [K]
        0, 1, … on the device.
    brightest : float
        Largest β⁰.
    samples : float
        Independent samples of speckle in each.

    Raises
    ------
    SarsplatError
        If the images are black.
    """

    def __init__(self, dataset: Dataset, device: torch.device) -> None:
        train, power = dataset.select("train"), torch.from_numpy(dataset.images("train"))
        self.views, self.grid, self.brightest = train.views, dataset.grid, float(power.max())
        if not self.brightest > _FAINTEST:
            raise SarsplatError(
                f"the training images of {dataset} are black everywhere (largest β⁰ {self.brightest:.3g}); "
                "simulate or import again"
            )
        self.samples = self.grid.independent_samples * (train.looks or 1.0)
        self.truth = power.to(device)
        self.numbers = torch.arange(len(self.views), device=device)
