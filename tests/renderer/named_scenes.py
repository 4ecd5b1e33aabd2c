"""Tiny named scenes for the renderer's tests: each is there for one thing that could go wrong."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sarsplat import MIN_SCALE, Gaussians, Ground, Harmonics, ImageGrid, RayGrid, Terrain, View, radar_frame
from sarsplat.renderer.echoes import GroundEcho

GRID = ImageGrid(20, 24, spacing_m=(0.2, 0.2), resolution_m=(0.3, 0.3))
FEW_PIXELS = ImageGrid(5, 6, spacing_m=(0.35, 0.35), resolution_m=(0.4, 0.45))
FEW_RAYS = RayGrid((0.27, 0.31))  # finite differences of every number take two renderings each
ODD = ImageGrid(19, 23, spacing_m=(0.2, 0.21), resolution_m=(0.3, 0.4))
VIEWS = (View(20.0, 40.0), View(200.0, 15.0), View(77.0, 75.0))
UNUSUAL = (View(20.0, 40.0, 25.0), View(200.0, 15.0, side="left"), View(77.0, 60.0, -40.0, "left"))


@dataclass(frozen=True)
class Scene:
    """Everything `render` takes; tensors in float32, the CPU engine's dtype."""

    gaussians: Gaussians
    views: tuple[View, ...] = VIEWS
    grid: ImageGrid = GRID
    rays: RayGrid | None = None
    amplitudes: Tensor | None = None
    shift: Tensor | None = None
    gain: Tensor | None = None
    imaging_weight: str = "area"
    ground: Ground | None = None
    first_return_depth: float | None = 0.5

    def leaves(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """Differentiable arguments by name, as fresh leaves."""
        optional = {"amplitudes": self.amplitudes, "shift": self.shift, "gain": self.gain}
        if self.ground is not None:
            optional |= {f"ground.{name}": getattr(self.ground, name) for name in ("gamma0", "exponent")}
        tensors = self.gaussians.tensors() | {k: t for k, t in optional.items() if t is not None}
        if self.amplitudes is not None:
            del tensors["scattering"]  # unused then
        return {name: tensor.detach().to(dtype, copy=True).requires_grad_() for name, tensor in tensors.items()}

    def call(self, renderer: Callable, leaves: dict[str, Tensor], **more: object):
        """Render with these leaves."""
        fields = self.gaussians.tensors()
        own = {name: leaves.get(name, tensor.to(leaves["means"])) for name, tensor in fields.items()}
        arguments: dict[str, object] = {"rays": self.rays or RayGrid.for_image(self.grid)}
        arguments |= {name: getattr(self, name) for name in ("imaging_weight", "first_return_depth")}
        arguments |= {name: leaves[name] for name in ("amplitudes", "shift", "gain") if name in leaves}
        if self.ground is not None:
            levels = {name: leaves[f"ground.{name}"] for name in ("gamma0", "exponent") if f"ground.{name}" in leaves}
            arguments["echoes"] = (GroundEcho(replace(self.ground, **levels)),)
        return renderer(self.gaussians.with_tensors(**own), self.views, self.grid, **arguments | more)


def cloud(
    count: int,
    seed: int,
    *,
    size: tuple[float, float, float] = (2.0, 2.0, 1.0),
    scale: float = 0.1,
    spread: float = 0.4,
    kappa: tuple[float, float] = (0.05, 2.0),
    degree: int = 3,
    p_min: float = 0.05,
) -> Gaussians:
    """Overlapping random Gaussians in a box, m; scales log-normal, optical depths log-uniform."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    tensors = (
        (uniform(count, 3) - 0.5) * torch.tensor(size, dtype=torch.float64),
        normal(count, 4),
        scale * torch.exp(spread * normal(count, 3)),
        kappa[0] * (kappa[1] / kappa[0]) ** uniform(count),
    )
    harmonics = Harmonics(normal(count, (degree + 1) ** 2).float(), p_min)
    return Gaussians(*(tensor.float() for tensor in tensors), scattering=harmonics)


FEW = partial(cloud, size=(0.5, 0.5, 0.5), scale=0.2, kappa=(0.7, 2.0))
"""Which overlap and occlude each other."""


def changed(gaussians: Gaussians, name: str, index: tuple[Any, ...], value: float) -> Gaussians:
    """The same with one number, or some rows, of a tensor replaced."""
    tensor = gaussians.tensors()[name].clone()
    tensor[index] = value
    return gaussians.with_tensors(**{name: tensor})


def with_scales(gaussians: Gaussians, scales: tuple[float, float, float]) -> Gaussians:
    """The same Gaussians, all of one shape."""
    return replace(gaussians, scales=torch.tensor(scales).expand(len(gaussians), 3).contiguous())


def wall(height_m: float, foot_m: float = 0.0) -> Gaussians:
    """Black and opaque, across the line of sight of a radar at azimuth 0, 6 m wide."""
    pitch = 0.05
    y, z = (
        axis.ravel() for axis in np.meshgrid(np.arange(-3, 3, pitch), np.arange(foot_m + pitch / 2, height_m, pitch))
    )
    n = len(y)
    return Gaussians(
        torch.from_numpy(np.column_stack([np.zeros(n), y, z])).float(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        torch.tensor([0.002, 0.6 * pitch, 0.6 * pitch]).repeat(n, 1),
        torch.full((n,), 4.0),
        Harmonics(torch.full((n, 1), -90.0), 0.0),
    )


def facing(view: View, offsets: Tensor) -> Tensor:
    """World positions of points given in a view's radar frame, [N, 3] → [N, 3]."""
    return (offsets.double() @ torch.from_numpy(radar_frame(view))).float()


def random_normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def some_dark(channels: int, count: int = 40) -> Tensor:
    """Amplitudes of either sign for three views; every seventh Gaussian is dark in every channel."""
    amplitudes = random_normal(channels, 3, count, channels)
    amplitudes[:, ::7] = 0.0
    return amplitudes


def _tied() -> Gaussians:
    # pairs share a centre, so their depths tie exactly in any dtype: the index must decide
    single = cloud(10, 21, kappa=(0.5, 2.0))
    both = cloud(20, 22, kappa=(0.5, 2.0))
    return replace(both, means=single.means.repeat(2, 1))


def _column() -> Gaussians:
    # a stack along the first view's line of sight: each stands in the shadow of those before it
    offsets = torch.stack([0.03 * torch.arange(6.0), -0.02 * torch.arange(6.0), 0.3 * torch.arange(6.0)], dim=1)
    return replace(cloud(6, 5, scale=0.15, kappa=(0.8, 1.5)), means=facing(VIEWS[0], offsets))


def _terrain(below_m: float, part: int = 1) -> Terrain:
    """Hills and hollows, some of which lie in each other's shadow or lay over each other; one part in so many of it."""
    x, y = np.meshgrid(0.3 * np.arange(-12 // part, 12 // part + 1), 0.25 * np.arange(-14 // part, 14 // part + 1))
    return Terrain(0.3 * np.sin(2.1 * x + 0.4) * np.cos(1.7 * y) + 0.1 * x - below_m, (0.3, 0.25))


def _textured(height_m: float | Terrain) -> Ground:
    """Ground of twelve places, that returns less at small angles."""
    return Ground(0.2 + 0.3 * random_normal(9, 3, 4).abs(), 0.9, height_m, torch.tensor(1.5))


def few_pixels(base: Gaussians, **more: object) -> Scene:
    """Two views of so few rays and pixels that finite differences of every number are fast."""
    both, shift, gain = (VIEWS[0], VIEWS[2]), 0.1 * random_normal(1, 2, 2), torch.tensor([1.3, 0.7])
    return replace(Scene(base, both, FEW_PIXELS, FEW_RAYS, shift=shift, gain=gain), **more)


GRADCHECK: dict[str, Callable[[], Scene]] = {
    "occluded column": lambda: few_pixels(replace(_column(), scattering=Harmonics(random_normal(2, 6, 1), 0.05))),
    "overlapping cloud, degree 3": lambda: few_pixels(FEW(3, 3)),
    "opaque, peak weight": lambda: few_pixels(
        cloud(4, 4, size=(0.4, 0.4, 0.6), scale=0.2, kappa=(2.0, 6.0), degree=1), imaging_weight="peak"
    ),
    "amplitudes given": lambda: few_pixels(FEW(4, 6), amplitudes=0.5 + random_normal(3, 2, 4, 2).abs()),
    "on the ground": lambda: few_pixels(FEW(3, 3, degree=0), ground=_textured(-0.3)),
    "on terrain": lambda: few_pixels(FEW(3, 3, degree=0), ground=_textured(_terrain(0.5, 2))),
}
"""A handful of Gaussians each, with overlap and occlusion, small enough for finite differences of every parameter."""

MATRIX: dict[str, Callable[[], Scene]] = {
    "overlap": lambda: Scene(cloud(60, 0)),
    "column": lambda: Scene(_column()),
    "opaque": lambda: Scene(cloud(60, 41, kappa=(4.0, 12.0))),
    "darkest": lambda: Scene(cloud(30, 2, kappa=(39.0, 40.0))),
    "transparent": lambda: Scene(cloud(60, 43, kappa=(0.002, 0.02)), first_return_depth=0.01),
    "invisible and not": lambda: Scene(_some_empty(cloud(40, 4))),
    "needles": lambda: Scene(with_scales(cloud(40, 5), (0.5, 0.01, 0.01))),
    "discs": lambda: Scene(with_scales(cloud(40, 6), (0.2, 0.2, 0.002))),
    "discs edge-on": lambda: Scene(_edge_on(cloud(30, 7))),
    "smaller than a ray": lambda: Scene(with_scales(cloud(60, 8, kappa=(5.0, 30.0)), (0.012, 0.01, 0.008))),
    "scale floor": lambda: Scene(with_scales(cloud(40, 9, kappa=(20.0, 40.0)), (0.1, 0.08, MIN_SCALE))),
    "larger than the image": lambda: Scene(cloud(5, 10, scale=3.0, spread=0.1), rays=RayGrid((0.5, 0.5))),
    "one large, some small": lambda: Scene(  # one takes more work than all others
        changed(cloud(7, 52, scale=0.03), "scales", (5,), 1.5), views=VIEWS[:1]
    ),
    "partly outside": lambda: Scene(cloud(60, 11, size=(8.0, 8.0, 2.0), scale=0.2), rays=RayGrid((0.2, 0.2))),
    "all outside": lambda: Scene(replace(cloud(20, 12), means=cloud(20, 12).means + torch.tensor([30.0, 0.0, 0.0]))),
    "none": lambda: Scene(cloud(0, 0), shift=0.1 * random_normal(4, 3, 2)),
    "one": lambda: Scene(cloud(1, 13, kappa=(1.0, 2.0))),
    "many views": lambda: Scene(
        cloud(20, 14),
        tuple(View(360.0 * k / 64, 20.0 + 50.0 * (k % 3) / 2) for k in range(64)),
        ImageGrid(16, 16, (0.25, 0.25), (0.3, 0.3)),
        rays=RayGrid((0.3, 0.3)),
    ),
    "one view": lambda: Scene(cloud(60, 15), views=VIEWS[:1]),
    "degree 0": lambda: Scene(cloud(40, 16, degree=0)),
    "degree 1": lambda: Scene(cloud(40, 17, degree=1)),
    "degree 2": lambda: Scene(cloud(40, 18, degree=2)),
    "no least scattering": lambda: Scene(replace(cloud(40, 19), scattering=Harmonics(4 * random_normal(19, 40, 16)))),
    "amplitudes given": lambda: Scene(cloud(40, 20), amplitudes=random_normal(5, 3, 40, 1).abs()),
    "three channels": lambda: Scene(cloud(40, 20), amplitudes=random_normal(5, 3, 40, 3)),
    "five channels": lambda: Scene(cloud(40, 20), amplitudes=some_dark(5)),
    "sixteen channels": lambda: Scene(cloud(40, 20), grid=ODD, amplitudes=some_dark(16)),
    "peak weight": lambda: Scene(cloud(40, 23), imaging_weight="peak"),
    "shift and gain": lambda: Scene(
        cloud(40, 44), shift=0.2 * random_normal(6, 3, 2), gain=torch.tensor([1.3, 0.2, 4.0])
    ),
    "image off centre": lambda: Scene(cloud(40, 25), grid=replace(GRID, center_m=(0.37, -0.61))),
    "oblong pixels": lambda: Scene(cloud(40, 26), grid=ImageGrid(33, 17, (0.3, 0.11), (0.5, 0.2), (0.1, 0.0))),
    "oblong rays": lambda: Scene(cloud(40, 27), rays=RayGrid((0.05, 0.13))),
    "coarse rays": lambda: Scene(cloud(40, 28), rays=RayGrid((0.4, 0.4))),
    "depth ties": lambda: Scene(_tied()),
    "one pixel": lambda: Scene(cloud(10, 29), grid=ImageGrid(1, 1, (0.2, 0.2), (0.5, 0.5))),
    "ground": lambda: Scene(cloud(40, 30), ground=Ground(torch.tensor(0.3), height_m=-0.55)),
    "ground of many levels": lambda: Scene(cloud(40, 31), ground=_textured(-0.55), gain=torch.tensor([1.3, 0.2, 4.0])),
    "ground, shifted": lambda: Scene(cloud(40, 32), ground=_textured(-0.55), shift=0.2 * random_normal(6, 3, 2)),
    "ground in three channels": lambda: Scene(
        cloud(40, 33), amplitudes=random_normal(5, 3, 40, 3), ground=Ground(torch.tensor(0.3), height_m=-0.55)
    ),
    "terrain": lambda: Scene(cloud(40, 34), ground=Ground(torch.tensor(0.3), height_m=_terrain(0.55))),
    "terrain, shifted": lambda: Scene(
        cloud(40, 35), ground=_textured(_terrain(0.55)), shift=0.2 * random_normal(6, 3, 2)
    ),
    "tilted or to the left": lambda: Scene(cloud(40, 36), UNUSUAL, shift=0.2 * random_normal(6, 3, 2)),
    "ground, tilted or to the left": lambda: Scene(
        cloud(40, 37), UNUSUAL, ground=_textured(-0.55), shift=0.2 * random_normal(6, 3, 2)
    ),
    "ground to the left": lambda: Scene(cloud(40, 38), UNUSUAL[1:2], ground=_textured(-0.55)),
    "terrain to the left": lambda: Scene(cloud(40, 39), UNUSUAL[1:2], ground=_textured(_terrain(0.55))),
    "many": lambda: Scene(  # more rows than a task or a block takes, of which few take time
        changed(cloud(1100, 50, scale=0.04), "optical_depth", (torch.arange(1100) % 4 > 0,), 0.0), views=VIEWS[:2]
    ),
}
"""What the engines are compared on. Rendering is cut (footprints, early stop, image), and a pair that lies on a cut to
float32's precision would fall on either side by chance: `test_no_pair_lies_on_a_cut` shows that these seeds have none.
"""


CLOUDS: dict[str, Callable[[], Gaussians]] = {
    "overlap": lambda: cloud(60, 0),
    "opaque": lambda: cloud(60, 41, kappa=(4.0, 12.0)),
    "needles": lambda: with_scales(cloud(40, 5), (0.5, 0.01, 0.01)),
    "discs": lambda: with_scales(cloud(40, 6), (0.2, 0.2, 0.002)),
}
"""For what is not rendered in one call."""


def _some_empty(gaussians: Gaussians) -> Gaussians:
    empty = changed(gaussians, "optical_depth", (slice(0, None, 3),), 0.0)
    return changed(empty, "optical_depth", (slice(1, None, 6),), 5e-4)  # below the least that touches a ray


def _edge_on(gaussians: Gaussians) -> Gaussians:
    # the normal of every disc is perpendicular to the first view's line of sight
    azimuth = math.radians(VIEWS[0].azimuth_deg)
    half = (math.pi / 2 - azimuth) / 2  # turns the disc's own x axis into the flight direction
    quaternion = torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])
    flat = with_scales(gaussians, (0.001, 0.2, 0.2))
    return replace(flat, quaternions=quaternion.expand(len(gaussians), 4).contiguous())
