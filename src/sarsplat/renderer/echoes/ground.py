"""The echo of the ground, level or terrain: what it hides, and what it returns where the radar sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer.echoes.echo import Echo, Sighting
from sarsplat.renderer.echoes.lit_ground import lit_ground
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.echoes.terrain_cells import before_terrain, cells_of
from sarsplat.renderer.engines.chosen_views import by_view, candidates
from sarsplat.renderer.engines.on_device import kept_on_device
from sarsplat.renderer.places import at_places


@dataclass(frozen=True)
class GroundEcho(Echo):
    """The plane or the terrain on which rays end: what it hides, and what it returns where the radar sees it."""

    ground: Ground

    wants_ray_ends: ClassVar[bool] = True

    @property
    def _terrain(self) -> Terrain | None:
        """None if it is a plane."""
        return self.ground.height_m if isinstance(self.ground.height_m, Terrain) else None

    def check(self, gaussians: Gaussians) -> None:
        ground, like = self.ground, gaussians.means
        for name, tensor in (("gamma0", ground.gamma0), ("exponent", ground.exponent)):
            if tensor is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
                raise SarsplatError(
                    f"ground.{name} is {tensor.dtype} on {tensor.device} but means is {like.dtype} on {like.device}; "
                    "use one floating dtype and one device for all tensors"
                )

    def values(self) -> dict[str, Tensor | None]:
        ground = self.ground
        exponent = None if ground.exponent is None else ground.exponent.reshape(1)
        return {"ground.gamma0": ground.gamma0.reshape(-1), "ground.exponent": exponent}

    def visible(self, gaussians: Gaussians) -> Gaussians:
        """Those whose centres are above a plane; what terrain hides depends on the view."""
        if isinstance(self.ground.height_m, Terrain):
            return gaussians
        hidden = gaussians.means[:, 2] < self.ground.height_m
        return replace(gaussians, optical_depth=gaussians.optical_depth.masked_fill(hidden, 0.0))

    def in_sight(
        self,
        means: Float[Tensor, "n 3"],
        views: Sequence[View],
        grid: ImageGrid,
        rays: RayGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v n"] | None:
        if (terrain := self._terrain) is None:
            return None
        return before_terrain(means, terrain, cells_of(terrain, views, grid, rays, shift), views, rays)

    def seen(self, sighting: Sighting) -> Float[Tensor, "v rows columns"]:
        """Of a plane, the share of it that a pixel sees; of terrain, γ⁰ and area as well."""
        s, ground = sighting, self.ground
        assert s.ends is not None  # wanted
        if isinstance(ground.height_m, Terrain):
            table = ground.gamma0 if ground.gamma0.ndim else ground.gamma0[None, None]
            how = ground.height_m, table.expand(len(s.views), -1, -1), ground.pitch_m, s.shift, s.new_pass
            return lit_terrain(s.ends, s.views, s.grid, s.rays, *how)
        if all(view.look.level for view in candidates(s.views)[0]):
            return lit_ground(s.ends, s.views, s.grid, s.rays, ground.height_m, s.shift, s.new_pass)
        ones = torch.ones(len(s.views), 1, 1, dtype=s.lit_area.dtype, device=s.lit_area.device)
        returned = lit_terrain(s.ends, s.views, s.grid, s.rays, ground.height_m, ones, 1.0, s.shift, s.new_pass)
        return returned / _numbers(ground, s.views)[0]

    def returned(
        self,
        seen: Float[Tensor, "v rows columns"],
        views: Sequence[View],
        grid: ImageGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v rows columns"]:
        ground = self.ground
        if isinstance(ground.height_m, Terrain):
            return seen if ground.exponent is None else seen * _law(ground, _numbers(ground, views)[1])
        return seen * free_plane(ground, ground.height_m, views, grid, shift)


def free_plane(
    ground: Ground,
    height_m: float,
    views: Sequence[View],
    grid: ImageGrid,
    shift: Float[Tensor, "v 2"] | None = None,
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """β⁰ of a plane that nothing hides."""
    table, device = ground.gamma0, ground.gamma0.device
    tangent, log_sine, sine, rise, *onto = _numbers(ground, views)
    level = tangent if ground.exponent is None else tangent * _law(ground, log_sine)
    if table.numel() == 1:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return (table.reshape(()) * level).expand(-1, 1, grid.columns).expand(-1, grid.rows, -1)
    x, r = (axis.to(table) for axis in _axes(grid, device))
    if shift is not None:
        x, r = x - shift[:, None, :1], r - shift[:, 1:, None]
    x, r = x - rise * height_m, r + sine * height_m  # as images show what is below, at z = 0
    across, along = (onto[k] * x + onto[2 + k] * r for k in range(2))
    return at_places(table, across, along, ground.pitch_m) * level


def _law(ground: Ground, log_sine: Float[Tensor, "v 1 1"]) -> Float[Tensor, "v 1 1"]:
    """(sin θ) to the ground's exponent, of the view's grazing angle."""
    assert ground.exponent is not None
    return (ground.exponent * log_sine).exp()


def _numbers(ground: Ground, views: Sequence[View]) -> Float[Tensor, "k v 1 1"]:
    """`_of_view` of each."""
    table = ground.gamma0
    return by_view(_of_view, views, table.device).to(table).T[..., None, None]


# A training asks for the same few views again and again, and a GPU should not be sent them each time.
@kept_on_device(maxsize=4096)
def _of_view(view: View, device: torch.device) -> Float64[Tensor, " 8"]:
    """β⁰ over γ⁰; ln sin θ, sin θ; height for each metre of azimuth; x, y on the ground for azimuth and slant range."""
    look = view.look
    numbers = look.slope, math.log(look.sine), look.sine, look.height_per_azimuth, *look.onto_ground.ravel()
    return torch.tensor(numbers, dtype=torch.float64, device=device)


@kept_on_device(maxsize=16)
def _axes(grid: ImageGrid, device: torch.device) -> tuple[Float64[Tensor, "1 1 w"], Float64[Tensor, "1 h 1"]]:
    """Azimuth and slant range of the pixels, m."""
    x, r = torch.from_numpy(grid.azimuth_m), torch.from_numpy(grid.range_m)
    return x[None, None].to(device), r[None, :, None].to(device)
