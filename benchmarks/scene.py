"""Something to render, forward and backward; it needs the renderer alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer import render

_OBLIQUE = View(azimuth_deg=0.0, grazing_deg=45.0)


@dataclass(frozen=True)
class Scene:
    """Gaussians, the views they are seen from, and the image they are seen in; rays stand at half a pixel."""

    gaussians: Gaussians
    views: tuple[View, ...]
    grid: ImageGrid

    @cached_property
    def leaves(self) -> Gaussians:
        """The Gaussians, differentiable."""
        tensors = self.gaussians.tensors().items()
        return self.gaussians.with_tensors(**{name: tensor.detach().requires_grad_() for name, tensor in tensors})

    @cached_property
    def rays(self) -> RayGrid:
        """Two rays to a pixel spacing, four to a pixel."""
        return RayGrid.for_image(self.grid)

    @cached_property
    def cotangent(self) -> Tensor:
        """What the images' gradient is, [V, rows, columns]."""
        shape = len(self.views), self.grid.rows, self.grid.columns
        return torch.rand(shape, generator=torch.Generator().manual_seed(1))

    def images(self) -> Tensor:
        """β⁰ [V, rows, columns] from the CPU engine."""
        return render(self.leaves, self.views, self.grid, rays=self.rays, engine="cpu").channel(0)

    def gradients(self, images: Tensor) -> list[Tensor]:
        """Of the images' inner product with the cotangent, to every tensor of the Gaussians."""
        return list(torch.autograd.grad(images, list(self.leaves.tensors().values()), self.cotangent))

    def step(self) -> list[Tensor]:
        """Forward and backward: the images and every gradient."""
        images = self.images()
        return [images.detach(), *self.gradients(images)]


def field(count: int, side: int, std_pixels: float) -> Scene:
    """A square image evenly filled with Gaussians, of standard deviation `std_pixels` in pixels; float32 throughout."""
    generator, pixel = torch.Generator().manual_seed(count), 0.3
    width = side * pixel
    extent = torch.tensor([width, width / math.cos(math.radians(_OBLIQUE.grazing_deg)), 2.0])

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(  # changed in place: what setting up leaves behind must not hide what rendering takes
        means=torch.rand(count, 3, generator=generator).sub_(0.5).mul_(extent),
        quaternions=normal(count, 4),
        scales=normal(count, 3).mul_(0.4).exp_().mul_(std_pixels * pixel),
        optical_depth=torch.rand(count, generator=generator).mul_(math.log(40.0)).exp_().mul_(0.05),
        scattering=Harmonics(normal(count, 16), p_min=0.05),
    )
    grid = ImageGrid(side, side, spacing_m=(pixel, pixel), resolution_m=(pixel, pixel))
    return Scene(gaussians, (_OBLIQUE,), grid)
