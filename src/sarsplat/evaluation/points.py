"""Distances between reconstructed points and the true surface (protocol R)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import cKDTree

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.unbroken import unbroken

_PIECES = 100
"""Triangles are cut into pieces, to find the nearest ones, whose edges are at most this part of the whole surface."""


@dataclass(frozen=True)
class Yardstick:
    """The lengths used to score points: fractions of the images' resolution cell.

    Parameters
    ----------
    cell_m : float
        The cell, m. Of images it is rounded to one significant digit, so that sensors that differ little are scored
        the same way.
    """

    cell_m: float

    @classmethod
    def of(cls, grid: ImageGrid) -> Yardstick:
        """The yardstick of images: 0.3 m both for cells of 0.3 m and for the 0.312 m of MSTAR."""
        return cls(_rounded(grid.cell_m))

    @property
    def thresholds_m(self) -> tuple[float, float, float]:
        """Largest distances at which a point counts as correct, m: the cell, two thirds and a third, to one digit."""
        return self.cell_m, _rounded(self.cell_m * 2 / 3), _rounded(self.cell_m / 3)

    @property
    def voxel_m(self) -> float:
        """Edge of the voxels in each of which at most one reconstructed point counts, m."""
        return self.cell_m / 15

    @property
    def ray_spacing_m(self) -> float:
        """Spacing of the rays that find the visible surface, m."""
        return self.cell_m / 30


def _rounded(length: float) -> float:
    return float(f"{length:.0e}")


@dataclass(frozen=True)
class PointMetrics:
    """Scores of reconstructed points against a surface."""

    accuracy_m: float
    """Mean distance of the reconstructed points from the surface, m."""
    completeness_m: float
    """Mean distance of the surface samples from the nearest reconstructed point, m."""
    cd_m: float
    """Chamfer distance: the mean of both means, m."""
    cd_squared_m2: float
    """The paper's: half the sum of the mean squared distances, m²."""
    precision: dict[float, float]
    recall: dict[float, float]
    f1: dict[float, float]
    """`precision`, `recall`, `f1` by threshold, m: share of points near the surface, of samples near a point, and their
    harmonic mean."""
    count: int
    """Number of reconstructed points left after thinning."""


@checks_arguments
def point_metrics(
    points: Float[np.ndarray, "p 3"],
    triangles: Float[np.ndarray, "t 3 3"],
    samples: Float[np.ndarray, "s 3"],
    yardstick: Yardstick,
) -> PointMetrics:
    """Score reconstructed points against one part of the true surface.

    Parameters
    ----------
    points : numpy.ndarray, float [P, 3]
        Reconstructed points, world frame, m; of each voxel only the first counts.
    triangles : numpy.ndarray, float [T, 3, 3]
        The true surface, against which accuracy and precision are measured exactly.
    samples : numpy.ndarray, float [S, 3]
        Area-weighted samples of the true surface, for completeness and recall.
    yardstick : Yardstick
        Thresholds and voxels; `Yardstick.of(grid)` for images on that grid.

    Raises
    ------
    SarsplatError
        If there is no point or no sample, or one is not finite, or no triangle has an area.
    """
    for name, values in (("reconstructed points", points), ("samples of the true surface", samples)):
        if values.ndim != 2 or values.shape[1] != 3 or len(values) == 0:
            raise SarsplatError(f"the {name} have shape {values.shape}; at least one point [P, 3] is needed")
        if not np.isfinite(values).all():
            raise SarsplatError(f"the {name} hold values that are not finite; remove them before evaluation")
    kept = thin(points, yardstick.voxel_m)
    to_surface = surface_distance(kept, triangles)
    to_points = unbroken(cKDTree(kept).query, samples, workers=-1)[0]
    thresholds = yardstick.thresholds_m
    precision = {threshold: float(np.mean(to_surface <= threshold)) for threshold in thresholds}
    recall = {threshold: float(np.mean(to_points <= threshold)) for threshold in thresholds}
    accuracy, completeness = float(to_surface.mean()), float(to_points.mean())
    return PointMetrics(
        accuracy_m=accuracy,
        completeness_m=completeness,
        cd_m=(accuracy + completeness) / 2,
        cd_squared_m2=float((to_surface**2).mean() + (to_points**2).mean()) / 2,
        precision=precision,
        recall=recall,
        f1={threshold: _harmonic_mean(precision[threshold], recall[threshold]) for threshold in thresholds},
        count=len(kept),
    )


def thin(points: Float[np.ndarray, "p 3"], voxel: float) -> Float[np.ndarray, "fewer 3"]:
    """The first point of every voxel (edge in m, anchored at the origin), float64 [≤ P, 3], in their old order."""
    cells = np.floor(points / voxel).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)].astype(np.float64)


def surface_distance(
    points: Float[np.ndarray, "p 3"], triangles: Float[np.ndarray, "t 3 3"]
) -> Float64[np.ndarray, " p"]:
    """Exact distance of each point from the nearest triangle, m; triangles without area are ignored.

    Triangles are cut into pieces within a radius r of their centres. The triangle of the nearest centre is at a
    distance d, and any nearer triangle has a piece whose centre is within d + r: those are tried, so none is missed.
    """
    from trimesh.triangles import nondegenerate

    triangles = triangles[nondegenerate(triangles)]
    if len(triangles) == 0:
        raise SarsplatError("the true surface has no triangle with an area, so no distance exists; check the mesh")
    centres, owners, radius = _pieces(triangles)
    tree = cKDTree(centres)
    nearest = owners[unbroken(tree.query, points, workers=-1)[1]]
    distance = _triangle_distance(points, triangles[nearest])

    nearby = unbroken(tree.query_ball_point, points, distance + radius * (1 + 1e-9), workers=-1)
    pairs = np.repeat(np.arange(len(points)), [len(pieces) for pieces in nearby]) * len(triangles)
    pairs = np.unique(pairs + owners[np.concatenate(nearby).astype(np.int64)])  # a triangle's pieces count once
    point, triangle = np.divmod(pairs, len(triangles))
    np.minimum.at(distance, point, _triangle_distance(points[point], triangles[triangle]))
    return distance


def _pieces(
    triangles: Float[np.ndarray, "t 3 3"],
) -> tuple[Float[np.ndarray, "pieces 3"], Int64[np.ndarray, " pieces"], float]:
    """Centres [N, 3] and triangles [N] of pieces of the triangles, and the largest radius about a centre.

    Halving the longest edge keeps the number of pieces of a long sliver proportional to its length.
    """
    corners = triangles.reshape(-1, 3)
    longest_edge = float(np.linalg.norm(np.ptp(corners, axis=0))) / _PIECES
    owners, done = np.arange(len(triangles)), []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
        small = edges.max(axis=1) <= longest_edge
        done.append((triangles[small], owners[small]))
        triangles, owners, longest = triangles[~small], owners[~small], edges[~small].argmax(axis=1)
        a, b, c = np.moveaxis(
            triangles[np.arange(len(triangles))[:, None], (longest[:, None] + np.arange(3)) % 3], 1, 0
        )
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        owners = np.concatenate([owners, owners])
    pieces, owners = (np.concatenate(part) for part in zip(*done, strict=True))
    centres = pieces.mean(axis=1)
    return centres, owners, float(np.linalg.norm(pieces - centres[:, None], axis=2).max())


def _triangle_distance(
    points: Float[np.ndarray, "p 3"], triangles: Float[np.ndarray, "p 3 3"]
) -> Float64[np.ndarray, " p"]:
    """Distance of each point from its own triangle, [P]."""
    from trimesh.triangles import closest_point

    return np.linalg.norm(closest_point(triangles, points) - points, axis=1)


def _harmonic_mean(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b > 0 else 0.0
