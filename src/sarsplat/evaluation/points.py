"""Distances between reconstructed points and the true surface (protocol R), and their alignment by a small motion.

Measured targets are near the middle of their chips and have a heading as accurate as the label; targets aloft are
rotated by errors of their assumed rotation. These offsets are no errors of the reconstruction, so points may be moved
before they are scored, but only a little, so that no other error is hidden.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import cKDTree

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.surface.cells import numbered
from sarsplat.threads import uninterruptible

_BATCH = 20_000  # points whose distances fit into a processor's cache
_SAMPLES_BATCH = 200_000  # at most a second between reports of progress
NORMALS_OFF_DEG = 30.0
"""Largest error of a correct normal, degrees."""
MOST_TURNED_DEG = 5.0
"""Largest rotation by an alignment, degrees."""
_FARTHEST = 3.0  # largest shift by an alignment along each axis, and cap of its distances, resolution cells
_ALIGNED = 4000  # points and surface samples used to align


@dataclass(frozen=True)
class Yardstick:
    """Lengths that scores of points use: fractions of the images' resolution cell."""

    cell_m: float
    """Resolution cell, m; `of` rounds it to one significant digit, so that similar sensors are scored alike."""

    @classmethod
    def of(cls, grid: ImageGrid) -> "Yardstick":
        """Yardstick of images: 0.3 m for cells of 0.3 m as well as for MSTAR's 0.312 m."""
        return cls(_rounded(grid.cell_m))

    @property
    def thresholds_m(self) -> tuple[float, float, float]:
        """Largest distances at which a point counts as correct, m: the cell, two thirds and a third, to one digit."""
        return self.cell_m, _rounded(self.cell_m * 2 / 3), _rounded(self.cell_m / 3)

    @property
    def voxel_m(self) -> float:
        """Edge of the voxels that thin reconstructed points to one each, m."""
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
    """Chamfer distance of the paper: half the sum of the mean squared distances, m²."""
    precision: dict[float, float]
    recall: dict[float, float]
    f1: dict[float, float]
    """`precision`, `recall`, `f1` by threshold, m: share of points near the surface, of samples near a point, and their
    harmonic mean."""
    count: int
    """Number of reconstructed points left after thinning."""
    normals_deg: float | None = None
    """Median angle between the points' normals and that of the nearest true triangle, whatever their signs, degrees;
    None if the points have no normals."""
    normals_off: float | None = None
    """Share of the points with an angle above `NORMALS_OFF_DEG`."""


@checks_arguments
def point_metrics(
    points: Float[np.ndarray, "p 3"],
    triangles: Float[np.ndarray, "t 3 3"],
    samples: Float[np.ndarray, "s 3"],
    yardstick: Yardstick,
    normals: Float[np.ndarray, "p 3"] | None = None,
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
    normals : numpy.ndarray, float [P, 3], optional
        Normals of the points, of any length, which are scored as well if given.

    Raises
    ------
    SarsplatError
        If there is no point, no sample or no triangle with an area, if numbers are not finite, or if the number of
        normals is not that of the points.
    """
    cloud = Cloud(points, yardstick, normals)
    _check("samples of the true surface", samples)
    return cloud.scores(triangles, side_by_side(samples))


class Cloud:
    """Reconstructed points, ready to be scored against several parts of the true surface (see `point_metrics`)."""

    def __init__(
        self, points: Float[np.ndarray, "p 3"], yardstick: Yardstick, normals: Float[np.ndarray, "p 3"] | None = None
    ) -> None:
        _check("reconstructed points", points)
        if normals is not None:
            _check("normals of the points", normals)
            if len(normals) != len(points):
                raise SarsplatError(f"{len(points)} points have {len(normals)} normals; give one for each, or none")
        first = first_of_voxels(points, yardstick.voxel_m)
        first = first[order_in_space(points[first].astype(np.float64))]
        self._points = points[first].astype(np.float64)
        self._normals = None if normals is None else normals[first].astype(np.float64)
        self._tree = cKDTree(self._points, leafsize=32, balanced_tree=False, compact_nodes=False)  # fastest
        self._thresholds_m = yardstick.thresholds_m

    def scores(
        self,
        triangles: Float[np.ndarray, "t 3 3"],
        samples: Float[np.ndarray, "s 3"],
        advanced: Callable[[float], object] = lambda share: None,
    ) -> PointMetrics:
        """Compute the scores of `point_metrics`; several times as fast if the samples are `side_by_side`.

        `advanced` is called from time to time with the share of the work done, 0 to 1.
        """
        to_surface, surface_normals = on_surface(self._points, triangles)
        normals_deg, normals_off = None, None
        if self._normals is not None:
            lengths = np.maximum(np.linalg.norm(self._normals, axis=1), np.finfo(float).tiny)
            cosine = np.abs(np.einsum("pc,pc->p", self._normals, surface_normals)) / lengths
            angle_deg = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
            normals_deg, normals_off = float(np.median(angle_deg)), float(np.mean(angle_deg > NORMALS_OFF_DEG))
        to_points = np.empty(len(samples))
        for first in range(0, len(samples), _SAMPLES_BATCH):
            part = slice(first, first + _SAMPLES_BATCH)
            to_points[part] = uninterruptible(self._tree.query, samples[part], workers=-1)[0]
            advanced(min(1.0, part.stop / len(samples)))
        precision = {threshold: float(np.mean(to_surface <= threshold)) for threshold in self._thresholds_m}
        recall = {threshold: float(np.mean(to_points <= threshold)) for threshold in self._thresholds_m}
        accuracy, completeness = float(to_surface.mean()), float(to_points.mean())
        return PointMetrics(
            accuracy_m=accuracy,
            completeness_m=completeness,
            cd_m=(accuracy + completeness) / 2,
            cd_squared_m2=float((to_surface**2).mean() + (to_points**2).mean()) / 2,
            precision=precision,
            recall=recall,
            f1={threshold: _harmonic_mean(precision[threshold], recall[threshold]) for threshold in precision},
            count=len(self._points),
            normals_deg=normals_deg,
            normals_off=normals_off,
        )


def _check(name: str, points: Float[np.ndarray, "p c"]) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise SarsplatError(f"the {name} have shape {points.shape}; at least one point [P, 3] is needed")
    if not np.isfinite(points).all():
        raise SarsplatError(f"the {name} hold values that are not finite; remove them before evaluation")


def side_by_side(points: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
    """Sort points so that neighbours in space are neighbours in memory, which speeds up searches."""
    points = points.astype(np.float64)
    return points[order_in_space(points)]


def order_in_space(points: Float64[np.ndarray, "p 3"]) -> Int64[np.ndarray, " p"]:
    """Indices of the points in the order of the leaves of a k-d tree."""
    return cKDTree(points, leafsize=64, compact_nodes=False, balanced_tree=False).indices


def first_of_voxels(points: Float[np.ndarray, "p 3"], voxel: float) -> Int64[np.ndarray, " fewer"]:
    """Indices of the first point of every voxel (edge in m, anchored at the origin), in order."""
    cells = np.floor(points / voxel).astype(np.int64)
    return np.sort(np.unique(numbered(torch.from_numpy(cells)).numpy(), return_index=True)[1])


def on_surface(
    points: Float[np.ndarray, "p 3"], triangles: Float[np.ndarray, "t 3 3"]
) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"]]:
    """Distance of each point from the nearest triangle, m, and that triangle's unit normal.

    Triangles without area are ignored. The nearest one is found in float32, its distance computed in float64.
    """
    import fcpw
    from trimesh.triangles import closest_point, nondegenerate

    points, triangles = np.asarray(points, np.float64), np.asarray(triangles)[nondegenerate(triangles)]
    if len(triangles) == 0:
        raise SarsplatError("the true surface has no triangle with an area, so no distance exists; check the mesh")
    middle = triangles.mean(axis=(0, 1))  # large coordinates would leave few digits for the distance
    scene = fcpw.scene_3D()
    scene.set_object_count(1)
    scene.set_object_vertices((triangles - middle).reshape(-1, 3).astype(np.float32), 0)
    scene.set_object_triangles(np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3), 0)
    scene.build(fcpw.aggregate_type.bvh_surface_area, True)
    distance, normals = np.empty(len(points)), np.empty((len(points), 3))
    for first in range(0, len(points), _BATCH):
        part, found = slice(first, first + _BATCH), fcpw.interaction_3D_list()
        batch = points[part]
        radii = np.full(len(batch), np.inf, np.float32)
        scene.find_closest_points((batch - middle).astype(np.float32), radii, found)
        nearest = triangles[np.fromiter((one.primitive_index for one in found), np.int64, len(batch))]
        distance[part] = np.linalg.norm(closest_point(nearest, batch) - batch, axis=1)
        normals[part] = np.cross(nearest[:, 1] - nearest[:, 0], nearest[:, 2] - nearest[:, 0])
    return distance, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _harmonic_mean(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b > 0 else 0.0


# ---- alignment ----
@dataclass(frozen=True)
class Alignment:
    """Rotations about the origin, about x, y and then the vertical, followed by a shift."""

    shift_m: tuple[float, float, float]
    """Shift in the world frame, m."""
    heading_deg: float
    """Rotation about the vertical, degrees, counter-clockwise from above."""
    farthest_m: float = math.inf
    """Largest shift allowed along each axis, m."""
    tilts_deg: tuple[float, float] = (0.0, 0.0)
    """Rotations about x and y, degrees; 0 unless the target is aloft."""

    def moved(self, points: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Return the points rotated and shifted, m."""
        return points @ _turn(self.heading_deg, *self.tilts_deg).T + np.array(self.shift_m)

    @property
    def at_limit(self) -> bool:
        """True if the shift or the rotation ended at its limit."""
        turns = self.heading_deg, *self.tilts_deg
        parts = (abs(part) / self.farthest_m for part in self.shift_m)
        return max(*parts, *(abs(turn) / MOST_TURNED_DEG for turn in turns)) > 0.98

    def __str__(self) -> str:
        x, y, z = self.shift_m
        tilts = " and ".join(f"{tilt:.1f}°" for tilt in self.tilts_deg)
        aloft = f", about x and y by {tilts}" if any(self.tilts_deg) else ""
        return f"moved by {x:.2f}, {y:.2f}, {z:.2f} m and turned by {self.heading_deg:.1f}°{aloft}"


def align(
    points: Float[np.ndarray, "p 3"], surface: Float[np.ndarray, "s 3"], cell: float, *, aloft: bool = False
) -> Alignment:
    """Find the motion that minimises the mean distances from points to surface and back.

    Parameters
    ----------
    points : numpy.ndarray, float [P, 3]
        Reconstructed points, m.
    surface : numpy.ndarray, float [S, 3]
        Samples of the known surface, m, spread by area.
    cell : float
        Side of a resolution cell, m. Points are moved by at most three cells, and distances are capped there.
    aloft : bool
        Rotate about all axes, not only about the vertical.
    """
    from scipy.optimize import minimize  # here: half a second to import

    rng = np.random.default_rng(0)
    own, true = (np.asarray(cloud, np.float64)[rng.permutation(len(cloud))[:_ALIGNED]] for cloud in (points, surface))
    farthest = _FARTHEST * cell
    to_own, to_true = cKDTree(own), cKDTree(true)

    def distance(motion: Float64[np.ndarray, " n"]) -> float:
        shift, turn = motion[:3] * farthest, _turn(*(motion[3:] * MOST_TURNED_DEG))
        distances = (
            to_true.query(own @ turn.T + shift, distance_upper_bound=farthest)[0],
            to_own.query((true - shift) @ turn, distance_upper_bound=farthest)[0],
        )
        return sum(float(np.minimum(one, farthest).mean()) for one in distances)

    free, options = 6 if aloft else 4, {"xtol": 1e-3, "ftol": 1e-5}
    best = minimize(distance, np.zeros(free), method="Powell", bounds=[(-1, 1)] * free, options=options).x
    x, y, z = (float(part) for part in best[:3] * farthest)
    heading_deg, tilt_x, tilt_y = (float(turn) * MOST_TURNED_DEG for turn in (*best[3:], 0.0, 0.0)[:3])
    return Alignment((x, y, z), heading_deg, farthest, (tilt_x, tilt_y))


def _turn(heading_deg: float, tilt_x_deg: float = 0.0, tilt_y_deg: float = 0.0) -> Float64[np.ndarray, "3 3"]:
    turn = np.eye(3)
    for axis, angle_deg in enumerate((tilt_x_deg, tilt_y_deg, heading_deg)):
        if angle_deg or axis == 2:
            cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
            around = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            turn = np.roll(around, axis - 2, axis=(0, 1)) @ turn
    return turn
