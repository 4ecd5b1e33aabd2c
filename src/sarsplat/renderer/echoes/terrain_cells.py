"""Ends of a view's rays on the ground, which are constant in a training, and occlusion of Gaussians by terrain.

In the plane of incidence of an azimuth, terrain of height h at ground range g lies at y_r = g sin θ + h cos θ and
z_r = g cos θ − h sin θ. The ray at y_r ends at the first g that reaches this elevation: lower
terrain behind it is in shadow, and where z_r falls as y_r rises, there is layover. A plane is all lit.
"""

import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, Look, RayGrid, Terrain, View
from sarsplat.renderer.engines.on_device import (
    ChosenViews,
    NotRecordable,
    being_recorded,
    by_view,
    candidates,
    is_read,
    kept_on_device,
)
from sarsplat.renderer.engines.problem import frame_of
from sarsplat.renderer.point_queries import at_places

RESPONSE_END = 6.0
"""Extent of the response, standard deviations: it vanishes in float32 beyond."""

_MARGIN = 8  # margin for displacements of images, pixels; larger ones need other rays
_MAX_RAYS = 1e8  # maximum rays of a view, and samples of the ground under them; a gigabyte

_MAX_GROUND = 1000.0
"""Maximum ground along a ray, relative to the extent shown: beyond it the grazing angle is too small."""

_CHUNK = 1 << 21  # heights that are interpolated at a time

_CACHE_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class Cells:
    """Slant ranges at which the rays of one view end, in cells δx wide and δy high of their lattice.

    The ray in row 0, column 0 stands at ((first[0] + ½) δx, (first[1] + ½) δy), as in the engines' lattices. A cell's
    lower and upper edges end at `low_m` and `high_m` [rows, columns], float32, on the CPU; its ground is between them;
    in layover `high_m` is smaller.
    """

    first: tuple[int, int]
    low_m: Float[Tensor, "rows columns"]
    high_m: Float[Tensor, "rows columns"]

    _copies: dict[torch.device, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    def edges(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return `low_m` and `high_m` on a device; copied once."""
        if device.type == "cpu":
            return self.low_m, self.high_m
        if device not in self._copies:
            if being_recorded():
                raise NotRecordable("has more terrain than the cache holds")
            self._copies[device] = self.low_m.to(device), self.high_m.to(device)
            torch.cuda.current_stream(device).synchronize()  # other threads use other streams
        return is_read(self._copies[device])


_latest: OrderedDict[tuple[Terrain | float, View, ImageGrid, RayGrid], Cells] = OrderedDict()
_LOCK = threading.Lock()


def _cached(*key: Any) -> Cells:
    """Return `_cells`, cached up to a gigabyte: a training renders the same few views again and again."""
    with _LOCK:
        if key not in _latest:
            _latest[key] = _cells(*key)
            while len(_latest) > 1 and sum(8 * cells.low_m.numel() for cells in _latest.values()) > _CACHE_BYTES:
                _latest.popitem(last=False)
        _latest.move_to_end(key)
        return _latest[key]


def cells_of(
    terrain: Terrain | float,
    views: Sequence[View],
    grid: ImageGrid,
    rays: RayGrid,
    shift: Float[Tensor, "v 2"] | None = None,
) -> list[Cells]:
    """Return the cells of each view's rays that end on terrain, or on the plane z = `terrain`, in images of a grid."""
    every, chosen = candidates(views)
    if shift is not None and chosen is not None:
        raise NotRecordable("asks how far images are displaced, since terrain beyond their edges may be seen")
    steps = 0 if shift is None else 1 + int(shift.detach().abs().max() / (_MARGIN * min(grid.spacing_m)))
    wider = replace(grid, rows=grid.rows + 2 * _MARGIN * steps, columns=grid.columns + 2 * _MARGIN * steps)
    return [_cached(terrain, view, wider, rays) for view in every]


def before_terrain(
    means: Float[Tensor, "n 3"], terrain: Terrain, ends: Sequence[Cells], views: Sequence[View], rays: RayGrid
) -> Float[Tensor, "v n"]:
    """Return 1 for Gaussians in sight of a view, 0 for those below the terrain or behind the end of their ray."""
    means = means.detach()
    heights = _heights(terrain, means.dtype, means.device)
    ground = at_places(heights, means[:, 0] / terrain.pitch_m[0], means[:, 1] / terrain.pitch_m[1], 1.0)
    above, masks = means[:, 2] >= ground, []
    if isinstance(views, ChosenViews):
        return (above & _before_ends(means, ends, views, rays)).to(means)
    for view, cells in zip(views, ends, strict=True):
        x, y, z = (means @ torch.from_numpy(view.look.frame).to(means).T).unbind(1)
        column, row = (
            (at / step).floor().long() - first for at, step, first in zip((x, y), rays.spacing_m, cells.first)
        )
        rows, columns = cells.low_m.shape
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        at = (row * columns + column)[inside].to("cpu")
        end = torch.maximum(*(edge.reshape(-1)[at] for edge in (cells.low_m, cells.high_m))).to(means)
        masks.append(above.clone())
        masks[-1][inside] &= z[inside] <= end
    return torch.stack(masks).to(means)


def _before_ends(
    means: Float[Tensor, "n 3"], ends: Sequence[Cells], views: ChosenViews, rays: RayGrid
) -> Bool[Tensor, "v n"]:
    """Return True for Gaussians before the end of their ray, for `ChosenViews`, without synchronising."""
    numbers, farthest = _farthest(tuple(ends), means.dtype, means.device)
    first_column, first_row, rows, columns, begin = numbers.index_select(0, views.numbers).T[..., None]
    x, y, z = (means @ by_view(frame_of, views, means.dtype, means.device).mT).unbind(-1)
    column = (x / rays.spacing_m[0]).floor().long() - first_column
    row = (y / rays.spacing_m[1]).floor().long() - first_row
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    at = (begin + row * columns + column).where(inside, 0)
    return ~inside | (z <= farthest.index_select(0, at.reshape(-1)).view(at.shape))


@kept_on_device(maxsize=16)
def _heights(terrain: Terrain, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "ny nx"]:
    return torch.from_numpy(terrain.heights_m).to(device, dtype)


@kept_on_device(maxsize=2)
def _farthest(
    ends: tuple[Cells, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Int64[Tensor, "v 5"], Float[Tensor, " cells"]]:
    """Return each view's (column, row, rows, columns, begin), and the larger slant range of all cells."""
    edges = [torch.maximum(cells.low_m, cells.high_m).reshape(-1) for cells in ends]
    begins = accumulate(map(len, edges), initial=0)
    numbers = [(*cells.first, *cells.low_m.shape, begin) for cells, begin in zip(ends, begins, strict=False)]
    farthest = torch.cat([*edges, torch.zeros(1)]).to(device, dtype)  # the last is of no cell
    return torch.tensor(numbers, dtype=torch.int64, device=device), farthest


def _cells(terrain: Terrain | float, view: View, grid: ImageGrid, rays: RayGrid) -> Cells:
    """Return the cells of rays that end in an image, or no farther from it than the response reaches."""
    (dx, dy), look = rays.spacing_m, view.look
    lowest, highest = terrain.span_m if isinstance(terrain, Terrain) else (terrain, terrain)
    azimuth_end, range_end = (RESPONSE_END * math.sqrt(variance) for variance in grid.response_variance_m2)
    left, right = grid.azimuth_m[0] - azimuth_end, grid.azimuth_m[-1] + azimuth_end
    near, far = grid.range_m[0] - range_end, grid.range_m[-1] + range_end
    (left, right), (bottom, top) = look.rays_to_ground((left, right), (near, far), (lowest, highest))
    first, end = (math.floor(left / dx), math.floor(bottom / dy)), (math.ceil(right / dx), math.ceil(top / dy))
    columns, rows = end[0] - first[0], end[1] - first[1]
    if columns * rows > _MAX_RAYS:
        raise SarsplatError(
            f"the view at azimuth {view.azimuth_deg:g}°, grazing {view.grazing_deg:g}° needs {columns * rows:.2g} rays "
            f"for terrain {highest - lowest:.4g} m high; cut it to what the images show, or use coarser rays"
        )
    if not isinstance(terrain, Terrain):
        x, y = ((start + np.arange(count)) * step for start, count, step in zip(first, (columns, rows + 1), (dx, dy)))
        ends = look.range_on_ground(x + dx / 2, y[:, None]) - terrain / look.sine
        ends = np.broadcast_to(ends, (rows + 1, columns)).astype(np.float32)
        low_m, high_m = (torch.from_numpy(edge) for edge in (ends[:-1], ends[1:]))
        return Cells(first, low_m, high_m)
    if not look.level:
        raise SarsplatError(
            f"the view at azimuth {view.azimuth_deg:g}°, grazing {view.grazing_deg:g}° is tilted by "
            f"{view.tilt_deg:g}°, under which only level ground can be rendered; resample its image to a level axis"
        )
    # terrain is lower than all rays before this section, and higher behind it
    begin = look.along_ray(first[1] * dy, highest)
    step = min(*terrain.pitch_m, look.along_ray(dy, 0.0))
    length = look.along_ray(rows * dy, lowest - highest)
    steps, shown_m = math.ceil(length / step) + 3, far - near + 2 * math.hypot(*terrain.half_m)
    if columns * steps > _MAX_RAYS and length > _MAX_GROUND * shown_m:  # nearly all of it is level, beyond the terrain
        least_deg = 1.1 * math.degrees(look.sine * length / (_MAX_GROUND * shown_m))  # allows rounding to two digits
        raise SarsplatError(
            f"the view at azimuth {view.azimuth_deg:g}°, grazing {view.grazing_deg:g}° looks along {length:.2g} m of "
            f"ground to see {shown_m:.4g} m; give grazing angles of at least {least_deg:.2g}°"
        )
    before = math.floor(begin / step)  # the same steps for every part of an image
    along = step * np.arange(before, before + steps)
    width, parts = max(1, _CHUNK // len(along)), []
    for column in range(0, columns, width):
        chunk = np.arange(column, min(column + width, columns))
        parts.append(_ends(terrain, look, (first[0] + chunk + 0.5) * dx, along, (first[1] * dy, dy, rows)))
    low, high = (np.concatenate(edges) for edges in zip(*parts))  # [columns, rows]
    shown = np.flatnonzero(((np.maximum(low, high) >= near) & (np.minimum(low, high) <= far)).any(axis=0))
    part = slice(int(shown[0]), int(shown[-1]) + 1) if len(shown) else slice(0, 0)
    low_m, high_m = (torch.from_numpy(np.ascontiguousarray(edge[:, part].T)) for edge in (low, high))
    return Cells((first[0], first[1] + part.start), low_m, high_m)


def _ends(
    terrain: Terrain,
    look: Look,
    x: Float64[np.ndarray, " c"],
    along: Float64[np.ndarray, " g"],
    elevation: tuple[float, float, int],
) -> tuple[Float32[np.ndarray, "c rows"], Float32[np.ndarray, "c rows"]]:
    """Return slant ranges at which lower and upper edges of cells end; `elevation` is (first, step, rows).

    Terrain is sampled at ground ranges `along`. A cell that passes a summit ends where its centre does.
    """
    place = x[:, None, None] * look.onto_ground[0] + along[None, :, None] * look.ahead
    height = terrain.height_m(place[..., 0], place[..., 1])  # [c, g]
    y, z = look.in_section(along, height)
    reached = np.maximum.accumulate(y, axis=1)
    first, step, rows = elevation
    halves = 2 * rows + 1  # edges, and centres between them
    count = np.clip(np.floor((reached - first) / (step / 2)).astype(np.int64) + 1, 0, halves)
    count[:, 0], count[:, -1] = 0, halves
    segment = np.repeat(
        np.broadcast_to(np.arange(len(along)), y.shape).ravel(), np.diff(count, axis=1, prepend=0).ravel()
    ).reshape(len(x), halves)
    line = np.arange(len(x))[:, None]
    y0, y1, z0, z1 = (table[line, segment - back] for table in (y, z) for back in (1, 0))
    share = np.clip((first + step / 2 * np.arange(halves) - y0) / (y1 - y0), 0.0, 1.0)
    end = z0 + share * (z1 - z0)
    shaded = np.cumsum(y < reached, axis=1)[line, segment - 1]
    broken = shaded[:, 1:] != shaded[:, :-1]
    lower, middle, upper = end[:, :-1:2], end[:, 1::2], end[:, 2::2]
    below, above = broken[:, ::2], broken[:, 1::2]
    low = np.where(below, np.where(above, middle, 2 * middle - upper), lower)
    high = np.where(above, np.where(below, middle, 2 * middle - lower), upper)
    return low.astype(np.float32), high.astype(np.float32)
