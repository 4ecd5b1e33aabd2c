"""Images (β⁰) and masks of a mesh by ray casting, which shares no code with the renderer.

Parallel rays along the line of sight start on the computation plane (x_r, y_r), dense along the edges of flat surfaces
and sparse within them; each deposits the cross-section γ⁰(i)·δx·δy of its first hit on the imaging plane (x_r, z_r),
which is convolved with the power response. Direct scattering, and optionally second bounces; no phase.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int32, Real, UInt8

from sarsplat.arguments import check_number, checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.geometry import CLUTTER, SHADOW, TARGET, ImageGrid, Look, Terrain, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.radiometry import to_db
from sarsplat.scenes._deposit import Deposit, NodeGrid
from sarsplat.scenes._parallel import in_order
from sarsplat.scenes._patches import Patches
from sarsplat.scenes._rays import Facets, Lattice, Region, Trace, first_hits, sparse_hits, tracer
from sarsplat.scenes._second_bounce import SecondBounce
from sarsplat.scenes.placement import warn_below_ground
from sarsplat.scenes.scattering import ScatteringLaw, check_ground, check_reflectivity, raise_first

_OFFSETS = (0.5, 0.5), (0.0, 0.0)  # ray offsets whose images are compared for the error of the rays
_FAINTEST = 1e-3  # minimum power of pixels for the error of the rays, relative to the brightest
_NO_TARGET = -1.0  # sentinel: reflectivity of terrain, so that no patch joins target and terrain
_RAYS_PER_RESOLUTION, _RAYS_PER_MESH = 15.0, 100.0
"""Minimum number of rays across a resolution cell, and along the mesh."""
_STEEPEST_DEG = 85.0  # maximum grazing angle of views whose images are full of terrain
_PARTS, _RAYS = 5, 2  # parts of a mask along each side of a pixel, and rays along the shorter side of a part
_OFFSET = 0.5, 0.5
_DIRECT = 0.1  # share of the direct image in the time of an image with second bounces


@checks_arguments
def simulate_raycast(
    mesh: Trimesh,
    view: View,
    grid: ImageGrid,
    law: ScatteringLaw,
    *,
    reflectivity: Real[np.ndarray, " faces"] | Sequence[float] | None = None,
    ground_gamma0: float | None = None,
    terrain: Terrain | None = None,
    bounces: int = 1,
    ground_reflectivity: float | None = None,
    ray_spacing: float | None = None,
    ray_offset: tuple[float, float] = (0.5, 0.5),
    oversample: int = 9,
) -> Float[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Simulate a SAR image of a mesh by ray casting.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Opaque triangles, m; orientation and closedness do not matter.
    view, grid
        Direction to the radar, and pixels.
    law : ScatteringLaw
        γ⁰ of the mesh's facets against incidence angle.
    reflectivity : numpy.ndarray [F], or a list, optional
        Factor on the law's γ⁰ for each face; 1 unless given.
    ground_gamma0 : float, optional
        γ⁰ (linear) of an infinite flat ground at z = 0, which hides everything below; no ground unless given.
    terrain : Terrain, optional
        Heights of that ground, instead of z = 0; each of its squares is two triangles.
    bounces : {1, 2}
        2: with second bounces, from facet to facet or between a facet and flat ground.
    ground_reflectivity : float, optional
        With second bounces on ground: |Γ|², the share of the power that it reflects like a mirror, 0 to 1.
    ray_spacing : float, optional
        Spacing δ of the square ray lattice near edges, m; `default_ray_spacing` unless given. Flat surfaces between
        edges need one ray in 64, and are deposited as finely as the resolution needs.
    ray_offset : (float, float)
        Offset of the lattice along its two axes, in spacings. Images of two offsets show the error of the rays.
    oversample : int
        Histogram nodes per pixel and axis; pixel centres are nodes. A hit is shared between the four nodes around it.

    Returns
    -------
    numpy.ndarray, float32 [rows, columns]
        β⁰: cross-section per unit slant-plane area, linear power; row 0 near range.

    Raises
    ------
    SarsplatError
        If the mesh has no faces or is not finite, or a setting is out of range.

    Warns
    -----
    SarsplatWarning
        If a good part of the mesh is below the ground.
    """
    spacing = default_ray_spacing(mesh, grid) if ray_spacing is None else ray_spacing
    scene: dict[str, Any] = {"reflectivity": reflectivity, "ground_gamma0": ground_gamma0, "terrain": terrain}
    scene |= {"bounces": bounces, "ground_reflectivity": ground_reflectivity}
    caster = RayCaster(mesh, grid, law, **scene, ray_spacing=spacing, ray_offset=ray_offset, oversample=oversample)
    warn_below_ground(mesh, grid, ground_gamma0, terrain)
    return caster.image(view)


class RayCaster:
    """Images of one mesh, from any views; the settings are those of `simulate_raycast`."""

    def __init__(
        self,
        mesh: Trimesh,
        grid: ImageGrid,
        law: ScatteringLaw,
        *,
        reflectivity: Real[np.ndarray, " faces"] | Sequence[float] | None,
        ground_gamma0: float | None,
        ray_spacing: float,
        terrain: Terrain | None = None,
        bounces: int = 1,
        ground_reflectivity: float | None = None,
        ray_offset: tuple[float, float] = (0.5, 0.5),
        oversample: int = 9,
    ) -> None:
        check_rays(mesh, ground_gamma0, ray_spacing, ray_offset)
        check_ground(ground_gamma0, terrain, bounces, ground_reflectivity)
        self._law = law
        self._reflectivity = check_reflectivity(reflectivity, len(mesh.faces))
        self._terrain_gamma0: Float64[np.ndarray, " t"] = np.empty(0)
        if terrain is not None:  # its triangles are traced like those of the mesh, and there is no other ground
            faces = len(mesh.faces)
            mesh = on_terrain(mesh, terrain, grid)
            self._terrain_gamma0 = np.full(len(mesh.faces) - faces, ground_gamma0)
            self._reflectivity = np.concatenate([self._reflectivity, np.full(len(mesh.faces) - faces, _NO_TARGET)])
            ground_gamma0 = None
        self._mesh, self._ground_gamma0 = mesh, ground_gamma0
        self._nodes = NodeGrid(grid, oversample)
        self._lattice = Lattice(Patches.of(mesh, self._reflectivity), ray_spacing, ray_offset, grid.resolution_m)
        self.power_by_echo: dict[View, dict[str, float]] = {}
        """Sum of the pixels (β⁰) of each image with second bounces so far, by kind of echo."""
        self._second: SecondBounce | None = None
        if bounces == 2:
            self._second = SecondBounce(mesh, law, self._reflectivity, self._lattice, ground_reflectivity)

    def image(
        self, view: View, progress: Callable[[float], object] = lambda share: None
    ) -> Float[np.ndarray, "rows columns"]:
        """Simulate the image of a view; `progress` is called with the finished share, several times a second."""
        check_unstretched([view])
        facets = Facets.of(self._mesh, view)
        gamma0 = self._reflectivity * self._law.gamma0(facets.cos_incidence)
        gamma0[len(gamma0) - len(self._terrain_gamma0) :] = self._terrain_gamma0
        look, ground = view.look, self._ground_gamma0
        if view.aloft and (ground is not None or len(self._terrain_gamma0)):
            raise SarsplatError("the view is of a target aloft, without ground; leave out ground_gamma0")
        trace = self._trace(facets, look)
        deposit, target = Deposit(self._nodes), Deposit(self._nodes)
        region = self._region(facets, view)
        direct = 1.0 if self._second is None else _DIRECT
        # change of slant range on the ground for each metre of the computation plane
        ground_slope = 0.0 if ground is None else math.hypot(1 / look.slope, look.range_on_ground(1.0, 0.0))
        hits = sparse_hits(self._lattice, facets, trace, region, ground_slope, lambda share: progress(direct * share))
        for hit in hits if not region.empty else ():
            x, y = hit.position.T
            deposit.add(x, hit.slant_range, gamma0[hit.face] * hit.area)
            if self._second is not None:
                target.add(x, hit.slant_range, gamma0[hit.face] * hit.area)
            if ground is not None:
                # Free ground has a closed form, without moiré; a ray that hits the target subtracts its contribution.
                deposit.add(x, look.range_on_ground(x, y), np.full(x.shape, -ground) * hit.area)
        image = deposit.image + (0.0 if ground is None else look.beta0_of_gamma0(ground))
        if self._second is not None:
            echoes = {"target": target.image} | ({} if ground is None else {"ground": image - target.image})
            second = self.second_bounces(view, lambda share: progress(direct + (1 - direct) * share))
            self.power_by_echo[view] = {kind: float(one.sum()) for kind, one in (echoes | second).items()}
            image = sum(second.values(), image)
        return np.maximum(image, 0.0).astype(np.float32)  # rounding leaves −1e-9 in full shadow

    def second_bounces(
        self, view: View, progress: Callable[[float], object] = lambda share: None
    ) -> dict[str, Float64[np.ndarray, "rows columns"]]:
        """Return β⁰ of second bounces by kind; empty with `bounces=1`."""
        if self._second is None:
            return {}
        facets = Facets.of(self._mesh, view)
        return self._second.images(view, facets, self._trace(facets, view.look), self._nodes, progress)

    def _trace(self, facets: Facets, look: Look) -> Trace:
        trace = tracer(facets)
        return trace if self._ground_gamma0 is None else _above_ground(facets, trace, look)

    def _region(self, facets: Facets, view: View) -> Region:
        """Return the region where rays can hit the mesh, or its shadow on the ground, within the image."""
        lower, upper = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
        heights = self._mesh.vertices[:, 2].min(), self._mesh.vertices[:, 2].max()
        if self._ground_gamma0 is not None:
            heights = min(heights[0], 0.0), max(heights[1], 0.0)
        x, y = view.look.rays_to_ground(self._nodes.columns.reach, self._nodes.rows.reach, heights)
        return Region((max(lower[0], x[0]), min(upper[0], x[1])), (max(lower[1], y[0]), min(upper[1], y[1])))


def _above_ground(facets: Facets, trace: Trace, look: Look) -> Trace:
    """Make a trace of rays that end on flat ground at z = 0."""

    def above(position: Float64[np.ndarray, "k 2"]) -> Int32[np.ndarray, " k"]:
        face = trace(position)
        hit = np.flatnonzero(face >= 0)
        below = facets.depth(face[hit], position[hit]) >= look.range_on_ground(*position[hit].T) + 1e-6
        face[hit[below]] = -1
        return face

    return above


def ray_error_db(mesh: Trimesh, view: View, grid: ImageGrid, law: ScatteringLaw, **settings: Any) -> float | None:
    """Estimate the error of an image by its rays: RMS, dB, over pixels within 30 dB of the brightest; None if empty.

    It compares two images with different rays of the same spacing; `settings` are those of `RayCaster`.
    """
    casters = [RayCaster(mesh, grid, law, **settings, ray_offset=offset) for offset in _OFFSETS]
    first, second = in_order(lambda caster, report: caster.image(view, report), casters)
    bright = np.minimum(first, second) > _FAINTEST * max(first.max(), second.max())
    if not bright.any():
        return None
    difference = to_db(first[bright].astype(np.float64)) - to_db(second[bright].astype(np.float64))
    return math.sqrt(float((difference**2).mean()) / 2)


def default_ray_spacing(mesh: Trimesh, grid: ImageGrid) -> float:
    """Return the spacing of rays near edges, m.

    It is a fifteenth of the finer resolution: two offsets of the lattice then agree to 65 dB on a vehicle. It is at
    most a hundredth of the mesh's extent, so that a target smaller than a resolution cell is not missed.
    """
    finest = min(grid.resolution_m) / _RAYS_PER_RESOLUTION
    extent = 0.0 if mesh.extents is None else float(mesh.extents.max())
    return min(finest, extent / _RAYS_PER_MESH) if 0 < extent < math.inf else finest


def check_rays(mesh: Trimesh, ground_gamma0: float | None, ray_spacing: float, ray_offset: tuple[float, float]) -> None:
    """Raise if a mesh, a ground or rays are invalid."""
    raise_first(
        (len(mesh.faces) == 0, "the mesh has 0 faces; give a mesh with triangles"),
        (
            not np.isfinite(mesh.vertices).all(),
            "the mesh has a vertex that is not finite; read it with load_mesh, which drops such faces",
        ),
        (not np.isfinite(ray_offset).all(), f"ray_offset {ray_offset} must be two finite numbers, in ray spacings"),
    )
    check_number("`ray_spacing`", ray_spacing, 0, above=True)
    check_ground(ground_gamma0)


def on_terrain(mesh: Trimesh, terrain: Terrain, grid: ImageGrid) -> Trimesh:
    """Append two faces for each square of the terrain to a mesh; the terrain continues level beyond its edges."""
    import trimesh

    sides = (grid.rows * grid.spacing_m[1], grid.columns * grid.spacing_m[0])
    reach = (math.hypot(*sides) + math.hypot(*grid.center_m)) / math.cos(math.radians(_STEEPEST_DEG))
    points = terrain.padded(reach)
    rows, columns = points.shape[:2]
    at = np.arange(rows * columns).reshape(rows, columns) + len(mesh.vertices)
    corner, right, up, both = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.column_stack(three) for three in ((corner, right, both), (corner, both, up))])
    vertices = np.concatenate([mesh.vertices, points.reshape(-1, 3)])
    return trimesh.Trimesh(vertices, np.concatenate([mesh.faces, faces]), process=False)


def raycast_masks(
    mesh: Trimesh, views: Sequence[View], grid: ImageGrid, *, progress: Callable[[int], object] | None = None
) -> UInt8[np.ndarray, "v {grid.rows} {grid.columns}"]:
    """Make `raycast_mask` of a mesh from every view; `progress` gets the number of finished ones after each."""
    masks = np.empty((len(views), grid.rows, grid.columns), np.uint8)
    for index, view in enumerate(views):
        masks[index] = raycast_mask(mesh, view, grid)
        if progress is not None:
            progress(index + 1)
    return masks


def raycast_mask(mesh: Trimesh, view: View, grid: ImageGrid) -> UInt8[np.ndarray, "{grid.rows} {grid.columns}"]:
    """Make the mask of a mesh on flat ground at z = 0: 0 clutter, 1 target (lit), 2 shadow; row 0 near range.

    A pixel is target if visible surfaces cover at least half of it, or if their area across the line of sight is at
    least half that of flat ground, because surfaces that face the radar cover little of the image. Layover counts;
    neither brightness nor resolution nor the orientation of triangles matters. Otherwise it is shadow if the mesh hides
    at least half of its ground. The ground hides everything below. Aloft, there is no shadow, and a plane at a grazing
    angle of 27° replaces flat ground. Raise `SarsplatError` if the mesh has no faces, is not finite or needs too many
    rays, or embreex is missing.
    """
    spacing = min(grid.spacing_m) / _PARTS / _RAYS
    check_rays(mesh, None, spacing, _OFFSET)
    check_unstretched([view])
    look = view.look
    slope_of_ground = 1 / view.open_beta0
    width, depth = grid.spacing_m
    left, near = grid.azimuth_m[0] - width / 2, grid.range_m[0] - depth / 2
    rows, columns = grid.rows * _PARTS, grid.columns * _PARTS
    begun = np.zeros((rows + 1) * columns, dtype=np.int64)  # surfaces that begin in a part, minus those that end
    appearing, hidden = np.zeros((2, grid.rows, grid.columns), dtype=np.int64)  # rays
    facets = Facets.of(mesh, view)
    for position, face in first_hits(facets, (left, left + grid.columns * width), spacing, _OFFSET):
        x, y = position.T
        z, z_ground = facets.depth(face, position), y * slope_of_ground + x * look.range_on_ground(1.0, 0.0)
        column = np.floor((x - left) / width * _PARTS)
        if view.aloft:
            z_ground = np.full(z.shape, np.inf)
        visible = (z < z_ground + 1e-6) & (column >= 0) & (column < columns)
        z, z_ground, face, column = z[visible], z_ground[visible], face[visible], column[visible].astype(np.int64)
        # one ray represents a square, which on a steep surface spans several parts in range
        reach = np.abs(facets.slope[face]).sum(axis=1) * spacing / 2
        ends = (np.clip(end, *facets.z_span[:, face]) for end in (z - reach, z + reach))
        # it covers the parts with centres between both ends
        first, beyond = (np.ceil((end - near) / depth * _PARTS - 0.5) for end in ends)
        for row, sign in ((first, 1), (beyond, -1)):
            parts = np.clip(row, 0, rows).astype(np.int64) * columns + column
            begun += sign * np.bincount(parts, minlength=len(begun))
        for counts, ranges in ((appearing, z), (hidden, z_ground)):
            row = np.floor((ranges - near) / depth)
            inside = (row >= 0) & (row < grid.rows)
            pixels = row[inside].astype(np.int64) * grid.columns + column[inside] // _PARTS
            counts += np.bincount(pixels, minlength=counts.size).reshape(counts.shape)
    covered = begun.reshape(rows + 1, columns)[:-1].cumsum(axis=0) > 0
    shares = covered.reshape(grid.rows, _PARTS, grid.columns, _PARTS).mean(axis=(1, 3))
    rays_on_open_ground = width * depth / slope_of_ground / spacing**2
    mask = np.where(hidden >= 0.5 * rays_on_open_ground, SHADOW, CLUTTER)
    lit = (shares >= 0.5) | (appearing >= 0.5 * view.yardstick * rays_on_open_ground)
    return np.where(lit, TARGET, mask).astype(np.uint8)
