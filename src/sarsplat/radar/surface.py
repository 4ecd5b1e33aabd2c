"""Surface of a target as opaque Gaussians with normals, for radar maps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.gaussians import Gaussians
from sarsplat.runs import Run
from sarsplat.scenes.splat_truth import surface_gaussians
from sarsplat.surface.masks import without_imitated_ground

_PIECE = 0.5  # edge of the pieces of a mesh, resolution cells


@dataclass(frozen=True)
class Surface:
    """Gaussians on a surface.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians on the CPU; their scattering is not used.
    normals : numpy.ndarray, float [N, 3]
        Unit normals of the surface, of either side, world frame.

    Raises
    ------
    SarsplatError
        If there is not one normal for each Gaussian.
    """

    gaussians: Gaussians
    normals: Float[np.ndarray, "n 3"]

    def __post_init__(self) -> None:
        if np.shape(self.normals) != (len(self.gaussians), 3):
            raise SarsplatError(
                f"normals has shape {np.shape(self.normals)}; for {len(self.gaussians)} Gaussians it must be "
                f"({len(self.gaussians)}, 3)"
            )


@checks_arguments
def surface_of_run(run: Run) -> Surface:
    """Surface of the target from a run: its Gaussians, or the triangles of a method without Gaussians.

    A Gaussian has the normal of the run's nearest point, and γ⁰ in the unit of `run.model`. Gaussians that may only
    imitate ground are dropped.

    Raises
    ------
    SarsplatError
        If there is neither a point nor a triangle.
    """
    model = run.model
    if model is None:
        return surface_of_mesh(run.mesh(), run.grid.cell_m)
    learned = model.target(model.degree(run.iteration)).detach().to("cpu")
    target = without_imitated_ground(learned, run.points, run.grid.cell_m, model.ground())
    if len(target) == 0:
        raise SarsplatError(f"{run.path or 'the run'} has no points of a target; train it for longer")
    nearest = cKDTree(run.points).query(target.means.double().numpy())[1]
    return Surface(target, np.asarray(run.normals, np.float64)[nearest])


@checks_arguments
def surface_of_mesh(mesh: Trimesh, cell_m: float) -> Surface:
    """Surface of triangles, m, in pieces of half a resolution cell of `cell_m`.

    Raises
    ------
    SarsplatError
        If the mesh has no area, or would take too many pieces.
    """
    gaussians, faces = surface_gaussians(mesh, _PIECE * cell_m)
    return Surface(gaussians, np.asarray(mesh.face_normals, np.float64)[faces])
