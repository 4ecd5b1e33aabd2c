"""Truth from the renderer (protocol R-self): a surface covered with small, flat Gaussians."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from sarsplat.arguments import check_number, checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.gaussians import MIN_SCALE, Gaussians, Harmonics
from sarsplat.geometry import View
from sarsplat.scenes.scattering import ScatteringLaw

# Tuned against the ray caster (docs/reference/forward-model.md): wider or denser discs bulge over edges and appear
# nearer than the surface, narrower or thinner ones leak.
_WIDENING = 1.2  # standard deviations of a Gaussian, relative to those of a uniform density on its piece
_SHEET_DEPTH = 7.0  # mean two-way optical depth of the surface
_THICKNESS = 0.01  # standard deviation along the normal, relative to the size of a piece
_MAX_GAUSSIANS = 1e7


@checks_arguments
def surface_gaussians(mesh: Trimesh, size: float) -> tuple[Gaussians, Int[np.ndarray, " n"]]:
    """Cover a mesh's surface, m, with flat Gaussians; return them, float32, and the face of each, int64 [N].

    Every triangle is bisected until its edges are no longer than `size`, m. Each piece becomes a Gaussian with its
    centre and second moments, widened by a constant factor so that neighbours overlap: standard deviations are at most
    0.29 of `size`. The mean optical depth of every piece is the same, so that the surface is opaque from all sides.
    Harmonics and p_min are zero: γ⁰ is given per view (`law_scattering`). Raise if `size` is not positive, the mesh has
    no area, or that would take too many Gaussians.
    """
    check_number("size", size, 0, above=True)
    check_number("the mesh's area in m²", mesh.area, 0, above=True)
    fewest = mesh.area / (size**2 / 4)
    if fewest > _MAX_GAUSSIANS:
        raise SarsplatError(
            f"the mesh has a surface of {mesh.area:.2g} m², which needs at least {fewest:.2g} Gaussians; "
            "if it is in millimetres, scale it to metres; otherwise use coarser pixels or ray casting"
        )
    pieces, faces = _bisected(np.asarray(mesh.triangles, dtype=np.float64), size)
    centers = pieces.mean(axis=1)
    spokes = pieces - centers[:, None]
    moments = _WIDENING**2 / 12 * np.einsum("nki,nkj->nij", spokes, spokes)
    variances, axes = np.linalg.eigh(moments)  # ascending: the first axis is the normal
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    # A triangle's area over 2π times the root of its moments' determinant is 3√3/π, whatever its shape.
    optical_depth = _SHEET_DEPTH * 3 * math.sqrt(3) / math.pi / _WIDENING**2
    n = len(centers)
    gaussians = Gaussians(
        means=torch.from_numpy(centers).float(),
        quaternions=torch.from_numpy(Rotation.from_matrix(axes).as_quat(scalar_first=True)).float(),
        scales=torch.from_numpy(np.sqrt(np.maximum(variances, max(_THICKNESS * size, MIN_SCALE) ** 2))).float(),
        optical_depth=torch.full((n,), optical_depth),
        scattering=Harmonics(torch.zeros(n, 1)),
    )
    return gaussians, faces


def _bisected(
    triangles: Float64[np.ndarray, "t 3 3"], size: float
) -> tuple[Float64[np.ndarray, "n 3 3"], Int[np.ndarray, " n"]]:
    """Halve longest edges until none exceeds `size`; return pieces [N, 3, 3] and the triangle of each [N]."""
    origin = np.arange(len(triangles))
    done, origins = [], []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        small = edges.max(axis=1) <= size
        done.append(triangles[small])
        origins.append(origin[small])
        triangles, origin, longest = triangles[~small], origin[~small], edges[~small].argmax(axis=1)
        row = np.arange(len(triangles))
        a, b, c = (triangles[row, (longest + k) % 3] for k in range(3))
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        origin = np.concatenate([origin, origin])
    return np.concatenate(done), np.concatenate(origins)


@checks_arguments
def law_scattering(
    normals: Float[np.ndarray, "n 3"] | Sequence[Sequence[float]], views: Sequence[View], law: ScatteringLaw
) -> Float64[np.ndarray, "v n"]:
    """Return γ⁰ of surface points with unit normals [N, 3] in every view, two-sided, linear, float64 [V, N].

    These are the amplitudes to pass to the renderer.
    """
    normals = np.asarray(normals, dtype=np.float64)
    facing = np.array([view.look.facing for view in views]).reshape(-1, 3)
    return law.gamma0(facing @ normals.T)


@checks_arguments
def law_by_ground(
    normals: Float[np.ndarray, "n 3"] | Sequence[Sequence[float]], views: Sequence[View], law: ScatteringLaw
) -> Float64[np.ndarray, "v n"]:
    """Return γ of surface points between the radar and the ground, per lit area: `GroundBounce.amplitudes`.

    It is the law's γ at the bisector of both directions, which is level; 0 where they are on different sides of the
    surface. Arguments are those of `law_scattering`.
    """
    normals = np.asarray(normals, dtype=np.float64)
    u = np.array([view.look.facing for view in views]).reshape(-1, 3)
    level, mirrored = u * (1.0, 1.0, 0.0), u * (1.0, 1.0, -1.0)
    bisector = level / np.linalg.norm(level, axis=1, keepdims=True)
    return law.gamma0(bisector @ normals.T) * ((u @ normals.T) * (mirrored @ normals.T) > 0)
