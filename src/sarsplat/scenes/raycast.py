"""Truth for experiments: β⁰ images of a triangle mesh by ray casting, which shares no code with the renderer.

Parallel rays along the line of sight stand on the computation plane (x_r, y_r); each deposits the cross-section
γ⁰(i)·δx·δy of its first hit on the imaging plane (x_r, z_r), which is then seen through the system's power response.
Direct scattering only: no multiple reflections, no phase.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float64, Int32, Real

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View, radar_frame
from sarsplat.radiometry import beta0_of_gamma0
from sarsplat.scenes._deposit import Deposit
from sarsplat.scenes.scattering import ScatteringLaw, check_ground, check_reflectivity

if TYPE_CHECKING:
    import trimesh

# The ray lattice is rotated by tan⁻¹((√5 − 1)/2), so that its lines are not parallel to an edge of a vehicle at a round
# azimuth: a whole row of rays would cross such an edge at once when the offset changes.
_LATTICE_TILT = math.atan((math.sqrt(5) - 1) / 2)

_RAYS_PER_RESOLUTION, _RAYS_PER_MESH = 15.0, 100.0  # across a resolution cell, and along the mesh
_RAYS_PER_BATCH = 1 << 20
_MAX_RAYS = 1e8  # a minute a view


@dataclass(frozen=True)
class Facets:
    """The mesh in the radar frame: depth of every triangle's plane as z = z0 + slope·(x, y), and its |cos i|."""

    vertices: Float64[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]
    z0: Float64[np.ndarray, " f"]
    slope: Float64[np.ndarray, "f 2"]
    z_span: Float64[np.ndarray, "2 f"]  # nearest and farthest vertex
    cos_incidence: Float64[np.ndarray, " f"]

    @classmethod
    def of(cls, mesh: trimesh.Trimesh, view: View) -> Facets:
        vertices = np.asarray(mesh.vertices, dtype=np.float64) @ radar_frame(view).T
        faces = np.asarray(mesh.faces, dtype=np.int32)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1)
        # A triangle seen exactly edge-on has no slope, and no ray hits it.
        seen = normal[:, 2] != 0
        slope = -np.divide(normal[:, :2], normal[:, 2:], where=seen[:, None], out=np.zeros((len(faces), 2)))
        cos_incidence = np.abs(np.divide(normal[:, 2], length, where=seen, out=np.zeros(len(faces))))
        depths = vertices[faces, 2]
        z0 = a[:, 2] - (slope * a[:, :2]).sum(axis=1)
        return cls(vertices, faces, z0, slope, np.stack([depths.min(axis=1), depths.max(axis=1)]), cos_incidence)

    def depth(self, face: Int32[np.ndarray, " k"], position: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, " k"]:
        """Range z_r of the planes of faces [K] at positions (x_r, y_r) [K, 2], kept within each triangle."""
        # In float64 from the plane, not from the intersector's float32; the clip tames planes seen almost edge-on.
        z = self.z0[face] + (self.slope[face] * position).sum(axis=1)
        return np.clip(z, *self.z_span[:, face])


@checks_arguments
def simulate_raycast(
    mesh: trimesh.Trimesh,
    view: View,
    grid: ImageGrid,
    law: ScatteringLaw,
    *,
    reflectivity: Real[np.ndarray, " faces"] | Sequence[float] | None = None,
    ground_gamma0: float | None = None,
    ray_spacing: float | None = None,
    ray_offset: tuple[float, float] = (0.5, 0.5),
    oversample: int = 9,
) -> Float[np.ndarray, "{grid.rows} {grid.columns}"]:
    """SAR image of a mesh, by ray casting.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Opaque triangles, m; orientation and closedness do not matter.
    view, grid
        Direction to the radar, and where the pixels lie.
    law : ScatteringLaw
        γ⁰ of the mesh's facets against incidence angle.
    reflectivity : numpy.ndarray [F], or a list, optional
        Factor on the law's γ⁰ for each face; 1 unless given.
    ground_gamma0 : float, optional
        γ⁰ (linear) of an infinite flat ground at z = 0; without it nothing lies behind the mesh. What lies below the
        ground is not seen.
    ray_spacing : float, optional
        Spacing δ of the square ray lattice, m; `default_ray_spacing` unless given.
    ray_offset : (float, float)
        Offset of the lattice along its two axes, in spacings. Comparing two shows how far the rays have converged.
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
    """
    if ray_spacing is None:
        ray_spacing = default_ray_spacing(mesh, grid)
    check_rays(mesh, ground_gamma0, ray_spacing, ray_offset)
    facets = Facets.of(mesh, view)
    gamma0 = check_reflectivity(reflectivity, len(mesh.faces)) * law.gamma0(facets.cos_incidence)
    cell_area = ray_spacing**2
    deposit = Deposit(grid, oversample)
    theta = math.radians(view.grazing_deg)
    for position, face in first_hits(facets, deposit.azimuth_reach, ray_spacing, ray_offset):
        x, y = position.T
        z = facets.depth(face, position)
        if ground_gamma0 is None:
            deposit.add(x, z, gamma0[face] * cell_area)
            continue
        # Height above the ground is y_r·cosθ − z_r·sinθ: rays reach it at z_r = y_r / tanθ. Free ground has a closed
        # form, without moiré; a ray that the target stops subtracts what it would have contributed there.
        z_ground = y / math.tan(theta)
        above = z < z_ground + 1e-6
        x, z, z_ground = x[above], z[above], z_ground[above]
        deposit.add(x, z, gamma0[face[above]] * cell_area)
        deposit.add(x, z_ground, np.full(x.shape, -ground_gamma0 * cell_area))
    image = deposit.image + (0.0 if ground_gamma0 is None else beta0_of_gamma0(ground_gamma0, view.grazing_deg))
    return np.maximum(image, 0.0).astype(np.float32)  # rounding leaves −1e-9 where the shadow is full


def default_ray_spacing(mesh: trimesh.Trimesh, grid: ImageGrid) -> float:
    """Spacing of the rays that images of a mesh need, m.

    A fifteenth of the finer resolution: two offsets of the lattice then agree to 65 dB on a vehicle. It is at most a
    hundredth of the mesh's extent, so that something smaller than a resolution cell is not missed.
    """
    finest = min(grid.resolution_m) / _RAYS_PER_RESOLUTION
    extent = 0.0 if mesh.extents is None else float(mesh.extents.max())
    return min(finest, extent / _RAYS_PER_MESH) if 0 < extent < math.inf else finest


def check_rays(
    mesh: trimesh.Trimesh, ground_gamma0: float | None, ray_spacing: float, ray_offset: tuple[float, float]
) -> None:
    """Refuse a mesh or settings that cannot be imaged."""
    if len(mesh.faces) == 0:
        raise SarsplatError("the mesh has 0 faces, so there is nothing to image; give a mesh with triangles")
    if not np.isfinite(mesh.vertices).all():
        raise SarsplatError("the mesh has a vertex that is not finite; read it with load_mesh, which drops such faces")
    check_ground(ground_gamma0)
    if not (math.isfinite(ray_spacing) and ray_spacing > 0):
        raise SarsplatError(f"ray_spacing {ray_spacing} must be positive and finite, in metres")
    if not np.isfinite(ray_offset).all():
        raise SarsplatError(f"ray_offset {ray_offset} must be two finite numbers, in ray spacings")


def first_hits(
    facets: Facets, azimuth_reach: tuple[float, float], spacing: float, offset: tuple[float, float]
) -> Iterator[tuple[Float64[np.ndarray, "k 2"], Int32[np.ndarray, " k"]]]:
    """Batches of rays that hit the mesh: positions (x_r, y_r) float64 [K, 2] and first-hit faces [K]."""
    lower, upper = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
    center = (lower + upper) / 2  # float32 keeps the most digits around zero
    run = _intersector(facets.vertices - center, facets.faces)
    x_range = max(lower[0], azimuth_reach[0]), min(upper[0], azimuth_reach[1])
    if x_range[0] > x_range[1]:
        return
    rays = (x_range[1] - x_range[0]) * (upper[1] - lower[1]) / spacing**2
    if rays > _MAX_RAYS:
        raise SarsplatError(
            f"the mesh spans {upper[1] - lower[1]:.4g} m of elevation, which needs {rays:.2g} rays {spacing:.4g} m "
            "apart; if it is in millimetres, scale it to metres; otherwise give a larger ray spacing or smaller images"
        )
    z_start = lower[2] - center[2] - max(1.0, spacing)
    for position in _lattice(x_range, (lower[1], upper[1]), spacing, offset):
        origins = np.column_stack([position - center[:2], np.full(len(position), z_start)]).astype(np.float32)
        face = run(origins)
        hit = face >= 0
        yield position[hit], face[hit]


def _intersector(vertices: Float64[np.ndarray, "v 3"], faces: Int32[np.ndarray, "f 3"]) -> Any:
    """Function from ray origins, float32 [K, 3], to the first faces hit along +z, int32 [K], −1 for none."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise SarsplatError("ray casting needs embreex; install it with: pip install 'sarsplat[simulate]'") from error
    scene = EmbreeScene(robust=True)  # watertight along shared edges
    TriangleMesh(scene=scene, vertices=vertices.astype(np.float32), indices=faces)
    direction = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
    return lambda origins: scene.run(origins, direction)


def _lattice(
    x: tuple[float, float], y: tuple[float, float], spacing: float, offset: tuple[float, float]
) -> Iterator[Float64[np.ndarray, "k 2"]]:
    """Points of the tilted square lattice within a rectangle, in batches, float64 [K, 2]."""
    cos, sin = math.cos(_LATTICE_TILT), math.sin(_LATTICE_TILT)
    turn = np.array([[cos, -sin], [sin, cos]])
    corners = np.array([(a, b) for a in x for b in y]) @ turn / spacing - offset
    first, last = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    along = np.arange(first[0], last[0] + 1) + offset[0]
    lines_per_batch = max(1, _RAYS_PER_BATCH // len(along))
    for start in range(first[1], last[1] + 1, lines_per_batch):
        across = np.arange(start, min(start + lines_per_batch, last[1] + 1)) + offset[1]
        u, v = np.meshgrid(along, across)
        position = spacing * np.column_stack([u.ravel(), v.ravel()]) @ turn.T
        inside = ((position >= (x[0], y[0])) & (position <= (x[1], y[1]))).all(axis=1)
        yield position[inside]
