"""Polarimetric scattering mechanisms of facets: one bounce, two bounces, or a volume of thin dipoles."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Complex128, Int64

from sarsplat.arguments import expect_fields
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import Trimesh
from sarsplat.geometry.stack import POLARISATIONS as KNOWN_POLARISATIONS

POLARISATIONS = ("HH", "HV", "VV")

SURFACE, DOUBLE_BOUNCE, VOLUME = range(3)
"""Indices into `MATRICES`."""

MATRICES: Complex128[np.ndarray, "3 3 3"] = np.array(
    [
        [[1.35, 0.0, 1.15], [0.0, 0.15, 0.0], [1.15, 0.0, 1.5]],
        [[1.65, 0.0, -1.2], [0.0, 0.15, 0.0], [-1.2, 0.0, 1.2]],
        [[9 / 7, 0.0, 3 / 7], [0.0, 3 / 7, 0.0], [3 / 7, 0.0, 9 / 7]],
    ],
    np.complex128,
)
"""E[y yᴴ] / γ⁰ in HH, HV, VV: HH and VV have equal signs after one bounce and opposite ones after two; random thin
dipoles are in between, with an eighth of their power in each cross-polarised channel."""

_LEVEL, _UPRIGHT = 0.9, 0.1
"""Minimum vertical component of the normals of level facets, and maximum one of upright facets."""

_TOLERANCE = 1e-9  # tolerance of negative eigenvalues of a matrix


@dataclass(frozen=True)
class Mechanisms:
    """Polarimetric covariance of each facet of a mesh and of the ground.

    Parameters
    ----------
    of_faces : numpy.ndarray, int64 [F]
        Index of each facet's matrix.
    of_ground : int
        Index of the ground's matrix.
    matrices : numpy.ndarray, complex128 [M, P, P]
        E[y yᴴ] / γ⁰ of the polarisations, Hermitian and positive semi-definite; if γ⁰ is to be the mean power, their
        mean diagonal is 1.
    polarisations : tuple of str
        Received and transmitted, such as "HV".

    Raises
    ------
    SarsplatError
        If shapes do not fit, or a matrix is not a covariance.
    """

    of_faces: Int64[np.ndarray, " f"]
    of_ground: int = SURFACE
    matrices: Complex128[np.ndarray, "m p p"] = field(default_factory=MATRICES.copy)
    polarisations: Sequence[str] = POLARISATIONS

    def __post_init__(self) -> None:
        expect_fields(self)
        names = tuple(self.polarisations)
        if not {*names} <= {*KNOWN_POLARISATIONS} or len({*names}) < len(names):
            raise SarsplatError(
                f"polarisations is {shown(names)}; give different ones of {', '.join(KNOWN_POLARISATIONS)}"
            )
        object.__setattr__(self, "polarisations", names)
        count, matrices = len(self.polarisations), self.matrices
        if matrices.ndim != 3 or matrices.shape[1:] != (count, count):
            raise SarsplatError(
                f"matrices has shape {matrices.shape}; for {count} polarisations give (M, {count}, {count})"
            )
        numbers = np.append(self.of_faces, self.of_ground)
        whole = self.of_faces.ndim == 1 and self.of_faces.dtype.kind in "iu"
        if not whole or numbers.min() < 0 or numbers.max() >= len(matrices):
            raise SarsplatError(
                f"of_faces is {self.of_faces.dtype} of shape {self.of_faces.shape}, and with of_ground from "
                f"{numbers.min():g} to {numbers.max():g}; give a whole number for each facet, 0 to {len(matrices) - 1}"
            )
        for matrix in matrices:
            hermitian = np.isfinite(matrix).all() and np.allclose(matrix, matrix.conj().T)
            if not hermitian or np.linalg.eigvalsh(matrix)[0] < -_TOLERANCE:
                raise SarsplatError(f"a matrix is {shown(matrix.tolist())}; give Hermitian, semi-definite ones")

    @classmethod
    def by_slope(cls, mesh: Trimesh) -> "Mechanisms":
        """Assign one bounce to level facets and the ground, two bounces to upright facets, volumes to all others.

        This is not the physics of a target, as rays meet one facet only, but makes scenes for polarimetry.
        """
        upward = np.abs(mesh.face_normals[:, 2])
        return cls(np.select([upward > _LEVEL, upward < _UPRIGHT], [SURFACE, DOUBLE_BOUNCE], VOLUME).astype(np.int64))

    @property
    def roots(self) -> Complex128[np.ndarray, "n p p"]:
        """Factor L of each facet's matrix L Lᴴ, and of the ground's at the end."""
        values, vectors = np.linalg.eigh(self.matrices)
        roots: Complex128[np.ndarray, "m p p"] = vectors * np.sqrt(values.clip(min=0))[:, None]
        return roots[np.append(self.of_faces, self.of_ground)]
