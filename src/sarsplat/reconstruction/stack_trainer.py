"""Training from stacks: what is compared are covariances between passes, or polarisations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Complex64, Float32
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError, shown
from sarsplat.gaussians import Polarimetric
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.losses import Loss
from sarsplat.reconstruction.stack_loss import covariance_nats
from sarsplat.reconstruction.trainer import Trainer
from sarsplat.reconstruction.training_images import TrainingImages
from sarsplat.renderer import Rendering


class StackImages(TrainingImages):
    """The training stacks of a dataset.

    Attributes
    ----------
    stacks : tuple of Stack
        Of each image.
    level : Tensor, complex64 [K, P, rows, columns]
        Of unit magnitude, with the phases of level ground, by which stacks are deramped.
    covariances : Tensor, complex64 [K, P, P, rows, columns]
        y_i y_j* of each pixel, averaged around it.
    """

    def __init__(self, dataset: Dataset, window: int, device: torch.device) -> None:
        super().__init__(dataset, device)
        train = dataset.select("train")
        assert train.signal is not None  # of stacks
        self.stacks, self._window = train.stacks, window
        self.level = level_phases(self.stacks, self.views, self.grid).to(device)
        signal = torch.from_numpy(train.signal).to(device)
        self.covariances = self.averaged(signal[:, :, None] * signal[:, None].conj(), self.level)

    def averaged(
        self, covariances: Complex64[Tensor, "v p p rows columns"], level: Complex64[Tensor, "v p rows columns"]
    ) -> Complex64[Tensor, "v p p rows columns"]:
        """Deramped, and averaged over the window around each pixel, at edges over what of it there is."""
        deramped = covariances * (level[:, :, None].conj() * level[:, None])
        parts = torch.view_as_real(deramped).movedim(-1, 3).flatten(0, 3)
        mean = avg_pool2d(parts[:, None], self._window, 1, self._window // 2, count_include_pad=False)[:, 0]
        v, p = covariances.shape[:2]
        return torch.view_as_complex(mean.unflatten(0, (v, p, p, 2)).movedim(3, -1).contiguous())


def level_phases(
    stacks: Sequence[Stack], views: Sequence[View], grid: ImageGrid
) -> Complex64[Tensor, "v p {grid.rows} {grid.columns}"]:
    """Of unit magnitude, with the phases of level ground."""
    phases = np.stack([stack.plane_phases(view, grid) for stack, view in zip(stacks, views, strict=True)])
    return torch.from_numpy(np.exp(1j * phases).astype(np.complex64))


def refuse_with_passes(config: Config, dataset: Dataset) -> None:
    """Refuse what is not known of covariances: it would be left out in silence.

    Raises
    ------
    SarsplatError
        If the configuration asks for it, or the dataset has no covariances to learn from.
    """
    if not (dataset.interferometric or dataset.polarimetric):
        has = "stacks of one offset and one polarisation" if dataset.passes else "single images"
        raise SarsplatError(
            f"the settings (preset {config.preset}) learn from stacks, and {dataset} has {has}; choose another preset, "
            "or auto, which learns from the power"
        )
    if dataset.polarimetric and config.scattering != Polarimetric.kind:
        raise SarsplatError(
            f"scattering is {config.scattering}, which is the same in all polarisations, and {dataset} has "
            f"{', '.join(dict.fromkeys(dataset.stacks[0].of_channels))}; choose {Polarimetric.kind}"
        )
    known = {"loss": "passes", "coarsest": 1, "tiles": 1, "ground": None, "surroundings": None, "densification": None}
    for name, value in known.items():
        if (asked := getattr(config, name)) != value:
            asked, remedy = ("on", "off") if value is None else (shown(asked), shown(value))
            raise SarsplatError(
                f"{name} is {asked}, which learning from passes knows nothing of; give {remedy}, or passes off"
            )


class StackTrainer(Trainer):
    """A `Trainer` that learns from the phases between passes as well; the loss is their likelihood."""

    images: StackImages

    def _images_of(self, dataset: Dataset) -> StackImages:
        assert self.config.passes is not None  # or there would be a `Trainer`
        return StackImages(dataset, self.config.passes.window, self.device)

    def _minimise(self, loss: Loss | None) -> Tensor:
        return self.images.truth.new_tensor(float(len(self.images.stacks[0])))

    def _compared(self, chosen: Sequence[int], left_out: Bool[Tensor, " n"] | None) -> tuple[Tensor, Rendering]:
        of, unit = self.images, self.model.unit
        covariances, rendering = self.model.covariances(
            [self.views[i] for i in chosen],
            [of.stacks[i] for i in chosen],
            of.grid,
            self.model.degree(self.iteration),
            rays=self._rays,
            numbers=torch.stack([of.numbers[i] for i in chosen]),
            dropped=left_out,
        )
        level, measured = (torch.stack([whole[i] for i in chosen]) for whole in (of.level, of.covariances))
        loss: Float32[Tensor, ""] = covariance_nats(of.averaged(covariances, level) / unit, measured / unit)
        return loss, rendering
