"""The ground in images: what it hides, and what it returns where the radar sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.lit_ground import RayEnds, lit_ground
from sarsplat.renderer.lit_terrain import lit_terrain
from sarsplat.renderer.places import at_places
from sarsplat.renderer.terrain_cells import before_terrain, cells_of


def above(gaussians: Gaussians, ground: Ground) -> Gaussians:
    """Those whose centres are above a plane; the others are hidden below it, and thin as air.

    What terrain hides depends on the view (`in_sight`).
    """
    if isinstance(ground.height_m, Terrain):
        return gaussians
    hidden = gaussians.means[:, 2] < ground.height_m
    return replace(gaussians, optical_depth=gaussians.optical_depth.masked_fill(hidden, 0.0))


def in_sight(
    means: Float[Tensor, "n 3"],
    ground: Ground | None,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Float[Tensor, "v n"] | None:
    """1 for Gaussians that lie before the terrain in a view, 0 for hidden ones; None without terrain."""
    if ground is None or not isinstance(ground.height_m, Terrain):
        return None
    terrain = ground.height_m
    return before_terrain(means, terrain, cells_of(terrain, views, grid, rays, shift), views, rays)


def check_ground(ground: Ground, like: Tensor, channels: int, channel: int, imaging_weight: str) -> None:
    """Refuse what does not fit the Gaussians and the images."""
    for name, tensor in (("gamma0", ground.gamma0), ("exponent", ground.exponent)):
        if tensor is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
            raise SarsplatError(
                f"ground.{name} is {tensor.dtype} on {tensor.device} but means is {like.dtype} on {like.device}; use "
                "one floating dtype and one device for all tensors"
            )
    if imaging_weight == "peak":
        raise SarsplatError("imaging_weight='peak' gives images without a unit, to which no ground can be added")
    if channel >= channels:
        raise SarsplatError(
            f"the ground returns power in channel {channel}, but amplitudes have {channels} channels; give those "
            "of all its channels"
        )


def ground_values(ground: Ground) -> dict[str, Tensor | None]:
    """What must be in range, by name."""
    exponent = None if ground.exponent is None else ground.exponent.reshape(1)
    return {"ground.gamma0": ground.gamma0.reshape(-1), "ground.exponent": exponent}


def gamma0_by_view(ground: Ground, views: int) -> Float[Tensor, "v ny nx"] | None:
    """γ⁰ that `lit` of terrain takes: views that are shared out have its gradients of their own."""
    if not isinstance(ground.height_m, Terrain):
        return None
    table = ground.gamma0
    return (table if table.ndim else table[None, None]).expand(views, -1, -1)


def lit(
    ends: RayEnds,
    ground: Ground,
    gamma0: Float[Tensor, "v ny nx"] | None,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None,
    new_pass: NewPass | None,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """What rays make of the ground: of a plane, the share of it that a pixel sees; of terrain, γ⁰ and area as well.

    By an engine's passes; None for the reference.
    """
    if isinstance(ground.height_m, Terrain):
        assert gamma0 is not None  # `gamma0_by_view`
        return lit_terrain(ends, views, grid, rays, ground.height_m, gamma0, ground.pitch_m, shift, new_pass)
    return lit_ground(ends, views, grid, rays, ground.height_m, shift, new_pass)


def returned(
    ground: Ground,
    lit: Float[Tensor, "v h w"],
    views: Sequence[View],
    grid: ImageGrid,
    shift: Float[Tensor, "v 2"] | None,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """β⁰ of the ground, as far as it is `lit`."""
    if isinstance(ground.height_m, Terrain):
        return lit if ground.exponent is None else lit * _law(ground, _numbers(ground, views)[1])
    return lit * free_plane(ground, ground.height_m, views, grid, shift)


def with_ground(
    images: Float[Tensor, "v c h w"], returned: Float[Tensor, "v h w"], channel: int
) -> Float[Tensor, "v c h w"]:
    """Images with what the ground returned in their channel of power."""
    power = torch.arange(images.shape[1], device=images.device) == channel
    return images + (returned[:, None] if len(power) == 1 else returned[:, None] * power.to(images)[:, None, None])


def free_plane(
    ground: Ground,
    height_m: float,
    views: Sequence[View],
    grid: ImageGrid,
    shift: Float[Tensor, "v 2"] | None = None,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """β⁰ of a plane that nothing hides."""
    table, device = ground.gamma0, ground.gamma0.device
    tangent, log_sine, sine, *onto = _numbers(ground, views)
    level = tangent if ground.exponent is None else tangent * _law(ground, log_sine)
    if table.numel() == 1:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return (table.reshape(()) * level).expand(-1, 1, grid.columns).expand(-1, grid.rows, -1)
    x, r = (axis.to(table) for axis in _axes(grid, device))
    if shift is not None:
        x, r = x - shift[:, None, :1], r - shift[:, 1:, None]
    r = r + sine * height_m  # r = ground range · cos θ − z · sin θ
    across, along = (onto[k] * x + onto[2 + k] * r for k in range(2))
    return at_places(table, across, along, ground.pitch_m) * level


def _law(ground: Ground, log_sine: Float[Tensor, "v 1 1"]) -> Float[Tensor, "v 1 1"]:
    """(sin θ) to the ground's exponent, of the view's grazing angle."""
    assert ground.exponent is not None
    return (ground.exponent * log_sine).exp()


def _numbers(ground: Ground, views: Sequence[View]) -> Float[Tensor, "k v 1 1"]:
    """`_of_view` of each."""
    table = ground.gamma0
    return torch.stack([_of_view(view, table.device) for view in views]).to(table).T[..., None, None]


# A training asks for the same few views again and again, and a GPU should not be sent them each time.
@lru_cache(maxsize=4096)
def _of_view(view: View, device: torch.device) -> Float64[Tensor, " 7"]:
    """Of θ: tan, ln sin and sin; and how x and y on the ground grow with azimuth and with slant range."""
    look = view.look
    numbers = look.slope, math.log(look.sine), look.sine, *look.onto_ground.ravel()
    return torch.tensor(numbers, dtype=torch.float64, device=device)


@lru_cache(maxsize=16)
def _axes(grid: ImageGrid, device: torch.device) -> tuple[Float64[Tensor, "1 1 w"], Float64[Tensor, "1 h 1"]]:
    """Azimuth and slant range of the pixels, m."""
    x, r = torch.from_numpy(grid.azimuth_m), torch.from_numpy(grid.range_m)
    return x[None, None].to(device), r[None, :, None].to(device)
