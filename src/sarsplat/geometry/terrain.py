"""Terrain: heights of the ground on a lattice."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64

from sarsplat.arguments import expect, is_number
from sarsplat.errors import SarsplatError
from sarsplat.geometry.place import Place

_EDGE_TOLERANCE = 0.01  # distance beyond an edge that still counts as on it, relative to the pitch


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground as heights over x and y: linear between lattice points, and constant beyond the outermost.

    Parameters
    ----------
    heights_m : numpy.ndarray [ny, nx]
        z on a lattice around the origin, m; rows along +y, columns along +x, at least two of each. Read-only.
    pitch_m : (float, float)
        Spacing of the lattice along x and y, m.
    place : Place, optional
        Georeference of the origin, at z = 0, if known.

    Raises
    ------
    SarsplatError
        If there are fewer than 2 × 2 heights, one is not finite, or a pitch is not positive.
    """

    heights_m: Float[np.ndarray, "ny nx"]
    pitch_m: tuple[float, float]
    place: Place | None = None

    def __post_init__(self) -> None:
        heights = self.heights_m
        expect(np.ndarray, heights_m=heights)
        if heights.dtype.kind != "f" or heights.ndim != 2 or min(heights.shape) < 2:
            raise SarsplatError(
                f"the terrain's heights are {heights.dtype} of shape {heights.shape}; give floats [ny, nx], at least "
                "2 × 2, in metres"
            )
        if not np.isfinite(heights).all():
            at = tuple(int(k) for k in np.argwhere(~np.isfinite(heights))[0])
            raise SarsplatError(f"the terrain's height {at} is {heights[at]}; replace it by a finite height")
        pitch = self.pitch_m
        if len(pitch) != 2 or not all(is_number(p) and math.isfinite(p) and p > 0 for p in pitch):
            raise SarsplatError(f"the terrain's pitch_m is {pitch}; give two positive, finite numbers of metres (x, y)")
        object.__setattr__(self, "heights_m", heights.astype(np.float64))
        object.__setattr__(self, "pitch_m", (float(pitch[0]), float(pitch[1])))

    def __repr__(self) -> str:
        return f"<Terrain: {self}>"

    def __str__(self) -> str:
        (ny, nx), (dx, dy), (low, high) = self.heights_m.shape, self.pitch_m, self.span_m
        return f"{(nx - 1) * dx:.4g} × {(ny - 1) * dy:.4g} m (x × y), heights {low:.3g} to {high:.3g} m"

    @cached_property
    def span_m(self) -> tuple[float, float]:
        """Lowest and highest z, m."""
        return float(self.heights_m.min()), float(self.heights_m.max())

    @property
    def half_m(self) -> tuple[float, float]:
        """Half extents of the lattice along x and y, m."""
        rows, columns = self.heights_m.shape
        return (columns - 1) / 2 * self.pitch_m[0], (rows - 1) / 2 * self.pitch_m[1]

    def height_m(self, x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Interpolate z at (x, y), m."""
        table, before, share = self.heights_m, [], []
        for at, half, pitch, count in zip((x, y), self.half_m, self.pitch_m, table.shape[::-1]):
            place = np.clip((at + half) / pitch, 0, count - 1)
            before.append(np.minimum(place.astype(np.int64), count - 2))
            share.append(place - before[-1])
        (column, row), (right, down) = before, share
        upper = table[row, column] * (1 - right) + table[row, column + 1] * right
        lower = table[row + 1, column] * (1 - right) + table[row + 1, column + 1] * right
        return upper * (1 - down) + lower * down

    def centred(self) -> "Terrain":
        """Return the terrain moved vertically to z = 0 at the origin."""
        middle = float(self.height_m(np.zeros(1), np.zeros(1))[0])
        place = None if self.place is None else replace(self.place, height_m=self.place.height_m + middle)
        return Terrain(self.heights_m - middle, self.pitch_m, place)

    def around(self, place: Place, reach_m: float) -> "Terrain":
        """Return the terrain in the frame of another place on it, cut to `reach_m` around it or where it ends.

        Heights keep their datum.

        Raises
        ------
        SarsplatError
            If the terrain has no georeference, or the place is outside it.
        """
        if self.place is None:
            raise SarsplatError("the terrain does not say where on earth it is; give one with a coordinate system")
        other = replace(place, height_m=self.place.height_m, height_above=self.place.height_above)
        away = self.place.from_ecef(other.ecef)[:2]
        margins = np.subtract(self.half_m, np.abs(away))
        if not margins.min() > 0:
            raise SarsplatError(
                f"the terrain is {2 * self.half_m[0]:.4g} m × {2 * self.half_m[1]:.4g} m around {self.place}, but the "
                f"scene is at {place}, {math.hypot(*away):.4g} m from there; give terrain that shows it"
            )
        ahead = self.place.axes @ other.axes[0]
        square = float(margins.min() / np.abs(ahead[:2]).sum())  # half of the largest one, turned, that is on it
        counts = [
            max(1, math.ceil(reach_m / pitch) if reach_m <= square else math.floor(square / pitch + _EDGE_TOLERANCE))
            for pitch in self.pitch_m
        ]
        xs, ys = (np.arange(-count, count + 1) * pitch for count, pitch in zip(counts, self.pitch_m, strict=True))
        places = np.stack([*np.meshgrid(xs, ys), np.zeros((len(ys), len(xs)))], axis=-1)
        own = self.place.from_ecef(other.to_ecef(places)).reshape(-1, 3)
        return Terrain(self.height_m(own[:, 0], own[:, 1]).reshape(places.shape[:2]), self.pitch_m, other)

    def padded(self, reach_m: float) -> Float64[np.ndarray, "ny nx 3"]:
        """Return the lattice (x, y, z), m, continued to ±`reach_m` where it ends before."""
        heights, axes = self.heights_m, []
        for half, pitch, count, axis in zip(self.half_m, self.pitch_m, heights.shape[::-1], (1, 0)):
            places = np.arange(count) * pitch - half
            if half < reach_m:
                places = np.concatenate([[-reach_m], places, [reach_m]])
                heights = np.pad(heights, [(1, 1) if k == axis else (0, 0) for k in range(2)], mode="edge")
            axes.append(places)
        return np.stack([*np.meshgrid(*axes), heights], axis=-1)


def heights_of(points: Float[np.ndarray, "n 3"], terrain: Terrain | None) -> Float[np.ndarray, " n"]:
    """Return the heights of points (x, y, z) above the terrain, or above z = 0, m."""
    return points[:, 2] if terrain is None else points[:, 2] - terrain.height_m(points[:, 0], points[:, 1])
