"""Reconstructed points and meshes from three sides, beside the true surface where it is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree

from sarsplat.colours import ERROR, HEIGHT, POWER, hollow
from sarsplat.errors import counted
from sarsplat.extras import Trimesh
from sarsplat.report.figure import Block, ColourBar, Panel, axis, colour_bar, scale_bar
from sarsplat.report.images import address, indexed
from sarsplat.scenes.surface_samples import blocks_of_samples

Corner = Float[np.ndarray, " 3"]
Points = Float[np.ndarray, "p 3"]
Seen = Int64[np.ndarray, "rows columns"]
"""Index of the visible point in each pixel, row 0 at the top; −1 in empty pixels."""

_LEAST_PIXELS, _MOST_PIXELS = 120, 450  # limits of the raster's longest side
_MARGIN = 0.025  # around points, relative to the longest side
_MOST_POINTS = _MOST_PIXELS**2  # drawn points of a cloud: more would hide each other
_NEIGHBOURS, _CLOSING = 4, 1.2  # width of a point, relative to the distance of its fourth neighbour

_LIGHT = np.array([0.4, -0.5, 0.77])  # direction towards the light on meshes
_AMBIENT = 0.25  # share of ambient light on meshes
_PIXELS = 420  # raster of meshes, along the longest side
_SAMPLES_PER_PIXEL, _MOST_SAMPLES = 8, 2_000_000  # of meshes: a pixel without samples is a hole
_MESH_MARGIN = 0.03  # around meshes, relative to the longest side

_BATCH = 1 << 14  # points: intermediate arrays stay in the processor's cache
_WIDEST = 15  # maximum width of a point, pixels


def point_boards(
    clouds: Mapping[str, Points], surface: Float[np.ndarray, "s 3"] | None, farthest_m: float, *, heights: bool = True
) -> tuple[tuple[Block, ...], tuple[ColourBar, ...]]:
    """Points from the side, the front and the top, coloured by height; then by their distances to the true surface.

    `clouds` are reconstructed points by name, `surface` samples the true surface, m; distances beyond `farthest_m`
    share one colour. Without `heights`, clouds are coloured by height only if there is no `surface`.
    """
    titles = [f"{name}, {counted(len(points), 'point')}" for name, points in clouds.items()]
    clouds = {name: _at_most(points, _MOST_POINTS) for name, points in clouds.items()}
    every = [*clouds.values(), *([] if surface is None else [surface])]
    low, high = _limits(np.concatenate(every))
    fewest = min((len(points) for points in every if len(points)), default=0)
    raster = Raster.around(low, high, int(np.clip(2 * np.sqrt(fewest), _LEAST_PIXELS, _MOST_PIXELS)))
    by_height, by_error, span = [], [], (float(low[2]), float(high[2]))
    truth = None if surface is None else _tree(surface)
    if surface is not None and truth is not None and heights:
        seen = raster.sides(surface, _point_width_m(truth))
        by_height.append(raster.board("true surface", seen, surface[:, 2], span, HEIGHT))
    for (name, points), title in zip(clouds.items(), titles, strict=True):
        seen = raster.sides(points, _point_width_m(_tree(points)))
        if heights or truth is None:
            by_height.append(raster.board(title, seen, points[:, 2], span, HEIGHT))
        if truth is not None:
            distances = _distances(truth, points, seen)
            by_error.append(raster.board(f"error of {name}", seen, distances, (0.0, farthest_m), ERROR))
    bars = [colour_bar("height z, m", HEIGHT, *span)] if by_height else []
    if by_error:
        bars.append(colour_bar("distance to the true surface, m", ERROR, 0, farthest_m))
    return (*by_height, *by_error), tuple(bars)


def _at_most(points: Points, most: int) -> Float[np.ndarray, "fewer 3"]:
    """A random subset of the points where there are too many."""
    return points if len(points) <= most else points[np.random.default_rng(0).choice(len(points), most, replace=False)]


def _tree(points: Points) -> cKDTree:
    """A k-d tree that is quick to build (its queries are slower)."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _point_width_m(cloud: cKDTree) -> float:
    """Width at which points are drawn to close the gaps between them, m: about the voxels that they were thinned to."""
    if cloud.n <= _NEIGHBOURS:
        return 0.0
    sample = cloud.data[:: max(1, cloud.n // 2000)]
    return _CLOSING * float(np.median(cloud.query(sample, k=[1 + _NEIGHBOURS])[0]))


def _distances(truth: cKDTree, points: Points, seen: Sequence[Seen]) -> Float[np.ndarray, " p"]:
    """Distances of the visible points to the true surface, m; 0 for hidden ones."""
    shown = np.concatenate([side[side >= 0] for side in seen])
    _, first = np.unique(shown, return_index=True)
    shown = shown[np.sort(first)]  # pixel by pixel: queries of neighbouring points are faster
    distances = np.zeros(len(points))
    distances[shown] = truth.query(points[shown])[0]
    return distances


def _limits(points: Points) -> tuple[Corner, Corner]:
    """Corners of the space shown, m, without outliers."""
    if len(points) == 0:
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    margin = _MARGIN * float((high - low).max()) or 1.0  # of a single point
    return low - margin, high + margin


def mesh_boards(reconstructed: Trimesh, truth: Trimesh | None) -> tuple[Block, ...]:
    """Shaded meshes (m) from the side, the front and the top, the true surface before the reconstructed one."""
    meshes = {f"reconstruction, {len(reconstructed.faces):,} triangles": reconstructed}
    if truth is not None:
        meshes = {"true surface": truth, **meshes}
    bounds = np.stack([mesh.bounds for mesh in meshes.values()])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    margin = _MESH_MARGIN * (high - low).max()
    raster = Raster.around(low - margin, high + margin, _PIXELS)
    return tuple(_board(raster, name, mesh) for name, mesh in meshes.items())


def _board(raster: "Raster", title: str, mesh: Trimesh) -> Block:
    count = min(int(_SAMPLES_PER_PIXEL * mesh.area / raster.pixel_m**2) + 1, _MOST_SAMPLES)
    sights, face_of = [Sight(raster, side) for side in SIDES], np.empty(count, np.int64)
    for first, places, faces in blocks_of_samples(mesh, count, np.random.default_rng(0)):
        face_of[first : first + len(faces)] = faces
        for sight in sights:
            sight.add(first, places)
    lit = _AMBIENT + (1 - _AMBIENT) * np.abs(mesh.face_normals @ (_LIGHT / np.linalg.norm(_LIGHT)))
    return raster.board(title, [sight.seen for sight in sights], lit[face_of], (0.0, 1.0), POWER)


# ---- points visible from a side -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Side:
    """Viewing direction given by world axes 0 to 2; `sign` is −1 if axis `towards` points away from the viewer."""

    name: str
    across: int
    up: int
    towards: int
    sign: int


SIDES = (Side("side", 0, 2, 1, -1), Side("front", 1, 2, 0, 1), Side("top", 0, 1, 2, 1))


@dataclass(frozen=True)
class Raster:
    """Square pixels over the box with corners `low` and `high`, m."""

    low: Corner
    high: Corner
    pixel_m: float

    @classmethod
    def around(cls, low: Corner, high: Corner, pixels: int) -> "Raster":
        """Divide the box into `pixels` along its longest side."""
        return cls(low, high, float((high - low).max()) / pixels)

    def sides(self, points: Points, width_m: float) -> list[Seen]:
        """Find the visible points, `width_m` wide, from each of the three sides."""
        size = int(np.clip(np.ceil(width_m / self.pixel_m), 1, _WIDEST))
        sights = [Sight(self, side, size) for side in SIDES]
        for first in range(0, len(points), _BATCH):
            for sight in sights:
                sight.add(first, points[first : first + _BATCH].T)
        return [sight.seen for sight in sights]

    def board(
        self, title: str, seen: Sequence[Seen], values: Float[np.ndarray, " p"],
        limits: tuple[float, float], colours: str,
    ) -> Block:  # fmt: skip
        """Three sides as panels that colour visible points by their values, between two limits."""

        def picture(points: Seen) -> str:
            covered, shades = points >= 0, np.zeros(points.shape, np.uint8)
            shades[covered] = np.maximum(indexed(values[points[covered]], *limits), 1)  # 0: nothing is there
            return address(shades, hollow(colours))

        size, panels = self.high - self.low, []
        names = ("x, m", "y, m", "z, m")
        for side, points in zip(SIDES, seen, strict=True):
            width, height = (float(size[k]) for k in (side.across, side.up))
            shares = height / width, width / float(size.max())
            ticks_down, ticks_across = (int(np.clip(round(4 * share), 2, 4)) for share in shares)
            down = axis(names[side.up], float(self.high[side.up]), float(self.low[side.up]), ticks_down)
            across = axis(names[side.across], float(self.low[side.across]), float(self.high[side.across]), ticks_across)
            panels.append(
                Panel(
                    side.name,
                    f"{title}, from the {side.name}",
                    across,
                    down,
                    aspect=width / height,
                    image=picture(points),
                    scale=scale_bar(width),
                )
            )
        return Block(title, tuple(panels), tuple(float(size[side.across]) for side in SIDES))


class Sight:
    """Depth buffer of one side: points come in batches and cover `size` × `size` pixels each."""

    def __init__(self, raster: Raster, side: Side, size: int = 1) -> None:
        self._raster, self._side = raster, side
        extent = raster.high - raster.low
        self._shape = [max(1, int(np.ceil(extent[axis] / raster.pixel_m))) for axis in (side.up, side.across)]
        self._near = np.full(self._shape, -np.inf).ravel()
        self._point = np.full(self._shape, -1).ravel()
        around = np.arange(size) - size // 2
        self._up, self._along = (step.ravel() for step in np.meshgrid(around, around))

    def add(self, first: int, places: Float[np.ndarray, "3 s"]) -> None:
        """Add points numbered from `first`; of equally near ones, the last is visible."""
        side, covered = self._side, len(self._up)
        row, column = (
            np.floor((places[k] - self._raster.low[k]) / self._raster.pixel_m).astype(np.int64)[:, None] + steps
            for k, steps in ((side.up, self._up), (side.across, self._along))
        )
        pixel = (row * self._shape[1] + column).ravel()
        near = np.repeat(side.sign * places[side.towards].astype(np.float64), covered)
        inside = (row >= 0) & (row < self._shape[0]) & (column >= 0) & (column < self._shape[1])
        drawn = np.flatnonzero(inside)
        drawn = drawn[near[drawn] >= self._near[pixel[drawn]]]  # few, once something is everywhere
        pixel, near = pixel[drawn], near[drawn]
        np.maximum.at(self._near, pixel, near)
        nearest = near == self._near[pixel]
        self._point[pixel[nearest]] = first + drawn[nearest] // covered

    @property
    def seen(self) -> Seen:
        """Visible points of those added so far."""
        return self._point.reshape(self._shape)[::-1]
