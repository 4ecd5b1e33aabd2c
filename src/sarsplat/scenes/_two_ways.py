"""Direct scattering between a transmitter and a receiver apart (bistatic).

Rays from the receiver find what it sees, dense everywhere, because the transmitter's shadows have edges anywhere; from
every hit a ray to the transmitter tells whether it is lit. A facet of area A returns γ⁰(|n·h|)·A·√((n·u_t)(n·u_r)),
with h halfway between both ways, and nothing if they are on different sides of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from sarsplat.geometry import View
from sarsplat.scenes._deposit import Deposit, NodeGrid
from sarsplat.scenes._rays import Facets, Region, first_hits, tracer
from sarsplat.scenes.scattering import ScatteringLaw

if TYPE_CHECKING:
    import trimesh

_CLEAR = 1e-5
"""How far above a facet the ray to the transmitter begins, as a share of the mesh's extent."""


def image_two_ways(
    mesh: trimesh.Trimesh,
    view: View,
    law: ScatteringLaw,
    reflectivity: Float64[np.ndarray, " faces"],
    nodes: NodeGrid,
    spacing: float,
    offset: tuple[float, float],
    progress: Callable[[float], object],
) -> Float64[np.ndarray, "rows columns"]:
    """β⁰ of a mesh in a bistatic view; arguments are those of the `RayCaster`."""
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
