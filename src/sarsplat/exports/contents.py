"""The contents of a run that can be exported: Gaussians, points, a mesh; never empty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.reconstruction import Run

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class Points:
    """Points of a surface.

    Attributes
    ----------
    positions, normals : numpy.ndarray, float32 [P, 3]
        World frame, m, and unit normals.
    gamma0 : numpy.ndarray, float32 [P], or None
        γ⁰, linear, if the method estimates it.
    """

    positions: Float32[np.ndarray, "p 3"]
    normals: Float32[np.ndarray, "p 3"]
    gamma0: Float32[np.ndarray, " p"] | None

    def columns(self) -> dict[str, Float32[np.ndarray, " p"]]:
        """The columns of the points besides their positions, by name."""
        normals = dict(zip(("nx", "ny", "nz"), self.normals.T, strict=True))
        return normals if self.gamma0 is None else {**normals, "gamma0": self.gamma0}


def name_of(run: Run) -> str:
    """The run's name in error messages."""
    return "the run in memory" if run.path is None else str(run.path)


def gaussians_of(run: Run) -> Gaussians:
    """The run's Gaussians; refused if its method learns none, or none are left."""
    gaussians = run.gaussians
    if gaussians is None:
        raise SarsplatError(
            f"{name_of(run)} was made by {run.method}, which learns no Gaussians; export its points or its "
            "mesh, such as with --format points to a .ply file"
        )
    if len(gaussians) == 0:
        raise SarsplatError(f"{name_of(run)} has no Gaussians left; reconstruct it again, or look at its report")
    return gaussians


def points_of(run: Run) -> Points:
    """The points of the run's surface; refused if there are none."""
    if len(run.points) == 0:
        raise SarsplatError(f"{name_of(run)} has no points of a surface yet; train it longer, or look at its report")
    return Points(run.points.astype(np.float32), run.normals, run.points_gamma0)


def mesh_of(run: Run) -> trimesh.Trimesh:
    """The run's surface as triangles; refused if there are none or a package is missing."""
    mesh = run.mesh()
    if len(mesh.faces) == 0:
        raise SarsplatError(
            f"{name_of(run)} has too few points of a surface for a mesh; train it longer, or look at its report"
        )
    return mesh
