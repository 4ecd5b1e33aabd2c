"""Flat patches of a mesh: away from their outlines, one ray represents many."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sarsplat.extras import Trimesh

_ROUNDINGS = 32  # tolerance of a flat patch, in roundings of float32, in which meshes are stored and rays are traced
_STEPS_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Patches:
    """Connected faces in one plane and of one reflectivity, and the edges between them.

    A square without outlines whose corners see one patch sees nothing else: anything in front has an outline there, and
    two planes that intersect in it leave a corner on either side.
    """

    of_face: Int64[np.ndarray, " f"]
    largest_face: Int64[np.ndarray, " patches"]  # defines the plane with the least rounding
    outlines: Int64[np.ndarray, "e 2"]  # vertices
    inner: Int64[np.ndarray, "i 4"]  # vertices of an edge within a patch, and those opposite to it on both sides

    @classmethod
    def of(cls, mesh: Trimesh, reflectivity: Float64[np.ndarray, " f"]) -> "Patches":
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        first, same = np.unique(vertices, axis=0, return_index=True, return_inverse=True)[1:]
        corners = first[same.reshape(-1)][np.asarray(mesh.faces)]  # merges coincident vertices
        a, b, c = (vertices[corners[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        double_area = np.linalg.norm(normals, axis=1)
        normals = normals / np.where(double_area > 0, double_area, 1.0)[:, None]
        tolerance = _ROUNDINGS * float(np.finfo(np.float32).eps) * float(np.abs(vertices).max())

        face = np.tile(np.arange(len(corners)), 3)
        opposite = np.concatenate([corners[:, k] for k in range(3)])
        ends = np.sort(np.concatenate([np.roll(corners, -k, axis=1)[:, 1:] for k in range(3)]), axis=1)
        order = np.lexsort(ends.T)
        ends, face, opposite = ends[order], face[order], opposite[order]
        begins = np.flatnonzero(np.r_[True, (ends[1:] != ends[:-1]).any(axis=1)])
        pair = begins[np.diff(np.r_[begins, len(ends)]) == 2]
        f, g = face[pair], face[pair + 1]
        # slivers have inaccurate planes, so one of both planes must fit
        off = [
            np.abs(((vertices[opposite[other]] - vertices[ends[pair, 0]]) * normals[face[own]]).sum(axis=1))
            for own, other in ((pair, pair + 1), (pair + 1, pair))
        ]
        joined = (np.minimum(*off) <= tolerance) & (reflectivity[f] == reflectivity[g])
        pair, f, g = pair[joined], f[joined], g[joined]
        links = coo_matrix((np.ones(len(f), dtype=bool), (f, g)), shape=(len(corners),) * 2)
        count, of_face = connected_components(links, directed=False)
        by_area = np.argsort(double_area, kind="stable")
        largest = np.zeros(count, dtype=np.int64)
        largest[of_face[by_area]] = by_area

        # A surface of fine facets bends slightly at every edge: each of its faces becomes a patch.
        plane = largest[of_face]
        distance = ((vertices[corners] - vertices[corners[plane, 0]][:, None]) * normals[plane][:, None]).sum(axis=2)
        bent = np.zeros(count, dtype=bool)
        bent[of_face[(np.abs(distance) > tolerance).any(axis=1)]] = True
        pair = pair[~bent[of_face[f]]]
        alone = np.flatnonzero(bent[of_face])
        of_face = of_face.astype(np.int64)
        of_face[alone] = count + np.arange(len(alone))
        within = np.zeros(len(ends), dtype=bool)
        within[pair] = within[pair + 1] = True
        outlines = ends[begins[~within[begins]]]
        inner = np.column_stack([ends[pair], opposite[pair], opposite[pair + 1]])
        return cls(of_face, np.concatenate([largest, alone]), outlines, inner)

    def outlines_from(self, position: Float64[np.ndarray, "v 2"]) -> Int64[np.ndarray, "e 2"]:
        """Return all edges that may occlude, given vertex positions across the line of sight: outlines and folds."""
        start, end, left, right = (position[self.inner[:, k]] for k in range(4))
        along = end - start
        sides = [along[:, 0] * (at - start)[:, 1] - along[:, 1] * (at - start)[:, 0] for at in (left, right)]
        folds = sides[0] * sides[1] >= 0
        return np.concatenate([self.outlines, self.inner[folds, :2]])


def entered_cells(
    start: Float64[np.ndarray, "e 2"], end: Float64[np.ndarray, "e 2"], shape: tuple[int, int]
) -> Bool[np.ndarray, "{shape[0]} {shape[1]}"]:
    """Mark unit squares of [0, columns] × [0, rows] that segments enter; positions (column, row)."""
    entered = np.zeros(shape, dtype=bool)
    limits = np.array([shape[1], shape[0]], dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.stack([(edge - start) / (end - start) for edge in (-1.0, limits + 1.0)])
    parallel = start == end
    crossings[:, parallel] = np.array([-np.inf, np.inf])[:, None]
    outside = (parallel & ((start < -1) | (start > limits + 1))).any(axis=1)
    first = np.clip(crossings.min(axis=0).max(axis=1), 0, 1)
    last = np.clip(crossings.max(axis=0).min(axis=1), 0, 1)
    near = (first <= last) & ~outside
    start, along, first, last = start[near], (end - start)[near], first[near, None], last[near, None]
    start, along = start + first * along, (last - first) * along
    steps = np.ceil(2 * np.abs(along).max(axis=1, initial=0.0)).astype(np.int64) + 1
    blocks = np.searchsorted(np.cumsum(steps), np.arange(0, steps.sum(), _STEPS_AT_ONCE), side="right")
    for segments in np.split(np.arange(len(steps)), blocks[1:]):
        count = steps[segments]
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        share = (step + 0.5) / np.repeat(count, count)
        at = np.repeat(start[segments], count, axis=0) + share[:, None] * np.repeat(along[segments], count, axis=0)
        for corner in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):  # a step is at most half a square
            column, row = np.floor(at + corner).astype(np.int64).T
            inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
            entered[row[inside], column[inside]] = True
    return entered
