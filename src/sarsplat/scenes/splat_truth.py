"""Truth for protocol R-self: a surface covered with small Gaussians, to be imaged by our own forward model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import KDTree

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import View
from sarsplat.scenes.scattering import ScatteringLaw

if TYPE_CHECKING:
    import trimesh

# Darts thrown per point asked for, and the least distance between points in units of sqrt(area / count): with so many
# darts the surface is nearly full, and this distance then gives the count asked for within a few per cent (measured).
_CANDIDATES_PER_POINT = 10
_DISTANCE = 0.76


def surface_gaussians(
    mesh: trimesh.Trimesh, count: int = 20_000, sigma: float = 0.06, optical_depth: float = 4.0, seed: int = 0
) -> tuple[Gaussians, np.ndarray]:
    """Isotropic Gaussians evenly spaced over a mesh's surface.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Surface, m.
    count : int
        Number of points asked for; a few per cent more or fewer are returned.
    sigma : float
        Standard deviation of every Gaussian, m.
    optical_depth : float
        Two-way peak optical depth of every Gaussian.
    seed : int
        The same seed gives the same points.

    Returns
    -------
    Gaussians
        float32; harmonics zero and p_min 0: the scattering is meant to be given per view (`law_scattering`).
    numpy.ndarray, float64 [N, 3]
        Unit normals of the faces the points lie on.

    Raises
    ------
    SarsplatError
        If `count` is not positive or the mesh has no area.
    """
    import trimesh

    if count < 1:
        raise SarsplatError(f"count {count} must be at least 1 surface point")
    if not mesh.area > 0:
        raise SarsplatError(f"the mesh has a surface of {mesh.area} m², so no points can be spread on it")
    candidates, faces = trimesh.sample.sample_surface(mesh, _CANDIDATES_PER_POINT * count, seed=seed)
    candidate_normals = np.asarray(mesh.face_normals[faces], dtype=np.float64)
    kept = _spread(candidates, candidate_normals, _DISTANCE * math.sqrt(mesh.area / count))
    n = len(kept)
    gaussians = Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(candidates[kept], dtype=np.float32)),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        scales=torch.full((n, 3), sigma),
        optical_depth=torch.full((n,), optical_depth),
        harmonics=torch.zeros(n, 1),
    )
    return gaussians, candidate_normals[kept]


def _spread(candidates: np.ndarray, normals: np.ndarray, distance: float) -> np.ndarray:
    """Indices of candidates [K, 3] kept by throwing them one by one, none closer than `distance` to one kept before it.

    The two sides of a thin plate, told apart by the normals, are filled independently.
    """
    pairs = KDTree(candidates).query_pairs(distance, output_type="ndarray")
    pairs = pairs[np.einsum("kc,kc->k", normals[pairs[:, 0]], normals[pairs[:, 1]]) > 0]
    later = np.sort(pairs, axis=1)
    later = later[np.lexsort(later.T[::-1])]
    starts = np.searchsorted(later[:, 0], np.arange(len(candidates) + 1))
    alive = np.ones(len(candidates), dtype=bool)
    for index in range(len(candidates)):
        if alive[index]:
            alive[later[starts[index] : starts[index + 1], 1]] = False
    return np.flatnonzero(alive)


def law_scattering(normals: np.ndarray, views: Sequence[View], law: ScatteringLaw) -> np.ndarray:
    """Scattering γ⁰ of surface points in every view, two-sided.

    Parameters
    ----------
    normals : numpy.ndarray [N, 3]
        Unit normals, world frame.
    views : sequence of View
        V views.
    law : ScatteringLaw
        γ⁰ against incidence angle.

    Returns
    -------
    numpy.ndarray, float64 [V, N]
        γ⁰, linear: the direct scattering P to give to the renderer.
    """
    towards_radar = np.array([view.direction for view in views]).reshape(-1, 3)
    return law.gamma0(towards_radar @ np.asarray(normals, dtype=np.float64).T)
