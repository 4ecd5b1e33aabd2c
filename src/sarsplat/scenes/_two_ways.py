"""Direct scattering between a transmitter and a receiver apart (bistatic).

Rays from the receiver find what it sees, dense everywhere, because the transmitter's shadows have edges anywhere; from
every hit a ray to the transmitter tells whether it is lit. A facet of area A returns γ⁰(|n·h|)·A·√((n·u_t)(n·u_r)),
with h halfway between both ways, and nothing if they are on different sides of it. Level ground has a closed form, from
which the places are taken away that either way does not reach.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from sarsplat.geometry import View
from sarsplat.geometry.look import Look
from sarsplat.scenes._deposit import Deposit, NodeGrid
from sarsplat.scenes._rays import Facets, Region, first_hits, tracer
from sarsplat.scenes.scattering import ScatteringLaw

if TYPE_CHECKING:
    import trimesh

_CLEAR = 1e-5
"""How far above a facet the ray to the transmitter begins, as a share of the mesh's extent."""

_AT_ONCE = 1 << 18
"""Places of the ground."""


def image_two_ways(
    mesh: trimesh.Trimesh,
    view: View,
    law: ScatteringLaw,
    reflectivity: Float64[np.ndarray, " faces"],
    nodes: NodeGrid,
    spacing: float,
    offset: tuple[float, float],
    progress: Callable[[float], object],
    *,
    stands: bool = False,
) -> Float64[np.ndarray, "rows columns"]:
    """β⁰ of a mesh in a bistatic view, of what is above z = 0 if it stands there; others are as for the `RayCaster`."""
    look, deposit = view.look, Deposit(nodes)
    lit_by, seen_from = view.legs
    facets, lit = Facets.of(mesh, seen_from), Facets.of(mesh, lit_by)
    frame, to_transmitter = seen_from.look.frame, lit_by.look.frame
    normals = np.asarray(mesh.face_normals)
    cos_in, cos_out = normals @ look.way_in, normals @ look.way_out
    both = cos_in * cos_out > 0  # on the same side
    # of an area across the way out
    power = reflectivity * law.gamma0(normals @ look.facing) * both
    power[both] *= np.sqrt(cos_in[both] / cos_out[both])
    shaded, clear_m = tracer(lit), _CLEAR * float(np.ptp(mesh.vertices, axis=0).max())
    lower, upper = facets.vertices.min(axis=0), facets.vertices.max(axis=0)
    region = Region((float(lower[0]), float(upper[0])), (float(lower[1]), float(upper[1])))
    rays = max(1.0, math.prod(high - low for low, high in (region.x, region.y)) / spacing**2)
    done = 0
    for position, face in first_hits(facets, (-math.inf, math.inf), spacing, offset):
        done += len(position)
        progress(min(1.0, done / rays))
        position, face = position[both[face]], face[both[face]]
        place = np.column_stack([position, facets.depth(face, position)]) @ frame
        if stands:
            above = place[:, 2] > 0
            place, face = place[above], face[above]
        x, y, z = to_transmitter @ place.T
        first = shaded(np.column_stack([x, y]))
        hit = first >= 0
        nearest = np.where(hit, 0.0, np.inf)
        nearest[hit] = lit.depth(first[hit], np.column_stack([x, y])[hit])
        # what is met first is the facet itself, or lies on it as its neighbours do at edges
        free = (first == face) | (nearest >= z - clear_m)
        azimuth, slant_range = look.gradients @ place[free].T
        deposit.add(azimuth, slant_range, power[face[free]] * spacing**2)
    progress(1.0)
    return deposit.image


def lit_level(look: Look) -> float:
    """β⁰ over γ⁰ of level ground that nothing hides."""
    across, away = look.onto_ground
    area = abs(across[0] * away[1] - across[1] * away[0])  # m² for each of the image
    return float(math.sqrt(look.way_in[2] * look.way_out[2]) * area)


def shadows_two_ways(
    mesh: trimesh.Trimesh, view: View, nodes: NodeGrid, spacing: float
) -> Float64[np.ndarray, "rows columns"]:
    """β⁰ over γ⁰ that level ground lacks where the mesh above it is in either way: negative, or 0.

    Places of the ground are tried as close as rays, and one ray from each to either end.
    """
    look, deposit = view.look, Deposit(nodes)
    above = np.asarray(mesh.vertices, dtype=np.float64)
    above = above[above[:, 2] > 0]
    if not len(above):
        return deposit.image
    legs = [(leg.look.frame, Facets.of(mesh, leg)) for leg in view.legs]
    traces = [tracer(facets) for _, facets in legs]
    inverse = np.linalg.inv(look.gradients[:, :2])
    feet = [(above - above[:, 2:] / way[2] * way)[:, :2] for way in look.ways]  # where their shadows end
    # and a mesh that reaches below the ground shades it from where it comes out
    shaded = np.concatenate([np.asarray(mesh.vertices)[:, :2], *feet]) @ look.gradients[:, :2].T
    reach = np.array([nodes.columns.reach, nodes.rows.reach]).T
    low, high = np.maximum(shaded.min(axis=0), reach[0]), np.minimum(shaded.max(axis=0), reach[1])
    azimuths, ranges = (np.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high, strict=True))
    lacking = -lit_level(look) * spacing**2
    for some in np.array_split(ranges, max(1, len(ranges) * len(azimuths) // _AT_ONCE)):
        at = np.stack(np.meshgrid(azimuths, some), axis=-1).reshape(-1, 2)
        place = np.column_stack([at @ inverse.T, np.zeros(len(at))])
        hidden = np.zeros(len(at), bool)
        for (frame, facets), trace in zip(legs, traces, strict=True):
            x, y, z = frame @ place.T
            first = trace(np.column_stack([x, y]))
            hit = first >= 0
            depth = facets.depth(first[hit], np.column_stack([x, y])[hit])
            hidden[np.flatnonzero(hit)[depth < z[hit]]] = True  # what is below the ground is farther away
        deposit.add(at[hidden, 0], at[hidden, 1], np.full(int(hidden.sum()), lacking))
    return deposit.image
