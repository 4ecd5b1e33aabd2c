"""What of a run can be exported: Gaussians, points, a mesh; refused if empty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from sarsplat.errors import SarsplatError, counted
from sarsplat.exports.format import Content
from sarsplat.runs import Run


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


def content_of(run: Run, content: Content) -> tuple[Any, str]:
    """A run's Gaussians, `Points`, mesh, or the run itself ("everything"), and what it is in words; never empty."""
    name = "the run in memory" if run.path is None else str(run.path)
    match content:
        case "gaussians":
            gaussians = run.gaussians
            if gaussians is None:
                raise SarsplatError(
                    f"{name} was made by {run.method}, which learns no Gaussians; export its points or its mesh, such "
                    "as with --format points to a .ply file"
                )
            if len(gaussians) == 0:
                raise SarsplatError(f"{name} has no Gaussians left; reconstruct it again, or look at its report")
            return gaussians, counted(len(gaussians), "Gaussian")
        case "points":
            if len(run.points) == 0:
                raise SarsplatError(f"{name} has no points of a surface yet; train it longer, or look at its report")
            points = Points(run.points.astype(np.float32), run.normals, run.points_gamma0)
            return points, f"{counted(len(run.points), 'point')}, metres, in the target's own frame"
        case "mesh":
            mesh = run.mesh()
            if len(mesh.faces) == 0:
                raise SarsplatError(
                    f"{name} has too few points of a surface for a mesh; train it longer, or look at its report"
                )
            return mesh, f"{counted(len(mesh.faces), 'triangle')}, metres, z up"
        case "everything":
            if len(run.points if run.gaussians is None else run.gaussians) == 0:
                raise SarsplatError(f"{name} has no surface yet; train it longer, or look at its report")
            return run, "all that was learned, as arrays"
