"""Echo of the ground, a plane or terrain: the Gaussians it hides, and its images where rays reach it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sarsplat.gaussians import Gaussians, Ground
from sarsplat.gaussians.gaussians import check_same_kind
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.renderer.echoes.echo import Echo, Sighting
from sarsplat.renderer.echoes.lit_ground import lit_ground
from sarsplat.renderer.echoes.lit_terrain import lit_terrain
from sarsplat.renderer.echoes.terrain_cells import before_terrain, cells_of
from sarsplat.renderer.engines.on_device import by_view, candidates, kept_on_device
from sarsplat.renderer.point_queries import at_places


@dataclass(frozen=True)
class GroundEcho(Echo):
    """Plane or terrain on which rays end."""

    ground: Ground

    wants_ray_ends: ClassVar[bool] = True

    def check(self, gaussians: Gaussians) -> None:
        own = {"ground.gamma0": self.ground.gamma0, "ground.exponent": self.ground.exponent}
        check_same_kind({"means": gaussians.means} | own)

    def values(self) -> dict[str, Tensor | None]:
        ground = self.ground
        exponent = None if ground.exponent is None else ground.exponent.reshape(1)
        return {"ground.gamma0": ground.gamma0.reshape(-1), "ground.exponent": exponent}

    def visible(self, gaussians: Gaussians) -> Gaussians:
        """Hide Gaussians whose centres are below a plane; those that terrain hides depend on the view."""
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
        terrain = self.ground.height_m
        if not isinstance(terrain, Terrain):
            return None
        return before_terrain(means, terrain, cells_of(terrain, views, grid, rays, shift), views, rays)

    def returned(self, sighting: Sighting) -> Float[Tensor, "v rows columns"]:
        s, ground = sighting, self.ground
        assert s.ends is not None  # wants_ray_ends
        if isinstance(ground.height_m, Terrain):
            table = ground.gamma0 if ground.gamma0.ndim else ground.gamma0[None, None]
            surface = ground.height_m, table.expand(len(s.views), -1, -1), ground.pitch_m, s.shift, s.new_pass
            beta0 = lit_terrain(s.ends, s.views, s.grid, s.rays, *surface)
            return beta0 if ground.exponent is None else beta0 * _law(ground, _look_numbers(ground, s.views)[1])
        every, _ = candidates(s.views)
        if all(view.look.level for view in every):
            lit_share = lit_ground(s.ends, s.views, s.grid, s.rays, ground.height_m, s.shift, s.new_pass)
        else:  # under a tilt, rays on the plane are not in rows: as on terrain, with γ⁰ = 1
            ones = torch.ones(len(s.views), 1, 1, dtype=s.lit_area.dtype, device=s.lit_area.device)
            beta0 = lit_terrain(s.ends, s.views, s.grid, s.rays, ground.height_m, ones, 1.0, s.shift, s.new_pass)
            lit_share = beta0 / _look_numbers(ground, s.views)[0]
        return lit_share * free_plane(ground, ground.height_m, s.views, s.grid, s.shift)


def free_plane(
    ground: Ground, height_m: float, views: Sequence[View], grid: ImageGrid, shift: Float[Tensor, "v 2"] | None = None
) -> Float[Tensor, "v {grid.rows} {grid.columns}"]:
    """Return β⁰ of a plane that nothing hides."""
    table, device = ground.gamma0, ground.gamma0.device
    tangent, log_sine, sine, rise, *onto = _look_numbers(ground, views)
    level = tangent if ground.exponent is None else tangent * _law(ground, log_sine)
    if table.numel() == 1:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return (table.reshape(()) * level).expand(-1, 1, grid.columns).expand(-1, grid.rows, -1)
    x, r = (axis.to(table) for axis in _axes(grid, device))
    if shift is not None:
        x, r = x - shift[:, None, :1], r - shift[:, 1:, None]
    x, r = x - rise * height_m, r + sine * height_m  # the places at z = 0 that images show there
    across, along = (onto[k] * x + onto[2 + k] * r for k in range(2))
    return at_places(table, across, along, ground.pitch_m) * level


def _law(ground: Ground, log_sine: Float[Tensor, "v 1 1"]) -> Float[Tensor, "v 1 1"]:
    """Return (sin θ) to the ground's exponent, θ being the view's grazing angle."""
    assert ground.exponent is not None
    return (ground.exponent * log_sine).exp()


def _look_numbers(ground: Ground, views: Sequence[View]) -> Float[Tensor, "k v 1 1"]:
    """Return the k = 8 numbers of `_of_look` for all views: β⁰/γ⁰ is the first, ln sin θ the second."""
    table = ground.gamma0
    return by_view(_of_look, views, table.device).to(table).T[..., None, None]


# A training asks for the same few views again and again, and a GPU should not be sent them each time.
@kept_on_device(maxsize=4096)
def _of_look(view: View, device: torch.device) -> Float64[Tensor, " 8"]:
    """Return β⁰/γ⁰, ln sin θ, sin θ, height per azimuth, and `Look.onto_ground` row by row."""
    look = view.look
    numbers = look.slope, math.log(look.sine), look.sine, look.height_per_azimuth, *look.onto_ground.ravel()
    return torch.tensor(numbers, dtype=torch.float64, device=device)


@kept_on_device(maxsize=16)
def _axes(grid: ImageGrid, device: torch.device) -> tuple[Float64[Tensor, "1 1 w"], Float64[Tensor, "1 h 1"]]:
    """Return azimuth and slant range of the pixels, m."""
    x, r = torch.from_numpy(grid.azimuth_m), torch.from_numpy(grid.range_m)
    return x[None, None].to(device), r[None, :, None].to(device)
