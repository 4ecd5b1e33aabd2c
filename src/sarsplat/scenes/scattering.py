"""Scattering law of surfaces (γ⁰ against incidence angle), speckle and its seeds, checks of ground and bounces."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from jaxtyping import Complex64, Float, Float32, Float64, Real
from scipy import fft
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sarsplat.arguments import check_number, checks_arguments, expect
from sarsplat.errors import SarsplatError
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, Terrain
from sarsplat.radiometry import from_db

_STREAMS: dict[str, tuple[int, ...]] = {"speckle": (), "reflectivity": (1,), "views": (2,), "scatterers": (3,)}
_MAX_GAMMA0 = 1e6
_MAX_SPREAD_DB = 10.0  # maximum standard deviation of factors on γ⁰: they span six orders of magnitude


def generator(seed: int, purpose: Literal["speckle", "reflectivity", "views", "scatterers"]) -> np.random.Generator:
    """Make the random generator for one purpose, independent of the others; raise if the seed is negative."""
    check_number("`seed`", seed, 0)
    return np.random.default_rng([seed, *_STREAMS[purpose]])


@dataclass(frozen=True)
class ScatteringLaw:
    """γ⁰(i) = floor + lobe·|cos i|^exponent, with i the angle between a facet's normal and the direction to the radar.

    Two-sided: both sides of a facet scatter the same, because the normals of real meshes cannot be trusted. γ⁰ is the
    cross-section per unit area projected along the line of sight, dimensionless and linear; per unit area of the facet
    itself it would be σ⁰ = γ⁰·cos i. So Lambert's law, σ⁰ ∝ cos²i, has the exponent 1 and no floor, and a constant γ⁰
    has no lobe.

    Parameters
    ----------
    floor : float
        γ⁰ at grazing incidence on the facet, ≥ 0.
    lobe : float
        γ⁰ at normal incidence beyond the floor, ≥ 0.
    exponent : float
        Narrowness of the lobe, ≥ 0; −3 dB at i = arccos(2^(−1/exponent)): 60° for 1, 45° for 2, 24° for 8.

    Raises
    ------
    SarsplatError
        If a coefficient is negative or above a million.
    """

    floor: float = 0.1
    lobe: float = 0.9
    exponent: float = 2.0

    def __post_init__(self) -> None:
        expect(float, **self.as_dict())
        for name, value in self.as_dict().items():
            check_number(f"the scattering law's {name}" + " (linear γ⁰)" * (name != "exponent"), value, 0, _MAX_GAMMA0)

    def gamma0(self, cos_incidence: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Return γ⁰ for the cosine of the incidence angle, of either sign; same shape and dtype."""
        return self.floor + self.lobe * np.abs(cos_incidence) ** self.exponent

    def as_dict(self) -> dict[str, float]:
        """Return the coefficients by name, for the record of a dataset; `ScatteringLaw(**d)` restores the law."""
        return asdict(self)


def part_reflectivity(mesh: Trimesh, spread_db: float, seed: int) -> Float64[np.ndarray, " faces"]:
    """Draw a factor on γ⁰ for each part of a mesh, and return that of each face: `reflectivity` of the simulators.

    Faces that share a corner belong to one part; factors are log-normal around 1 with this standard deviation.
    """
    check_number("the spread of the reflectivity in dB", spread_db, 0, _MAX_SPREAD_DB)
    corners = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    first, others = np.repeat(corners[:, :1], 2, axis=1).ravel(), corners[:, 1:].ravel()
    edges = coo_matrix((np.ones(len(first), dtype=bool), (first, others)), shape=(corners.max() + 1,) * 2)
    count, part = connected_components(edges, directed=False)
    factors = from_db(spread_db * generator(seed, "reflectivity").standard_normal(count))
    return factors[part[corners[:, 0]]]


@checks_arguments
def add_speckle(
    power: Real[np.ndarray, "*shape"], looks: float, rng: np.random.Generator
) -> Float[np.ndarray, "*shape"]:
    """Multiply an intensity image by fully developed, spatially white speckle.

    Parameters
    ----------
    power : numpy.ndarray
        β⁰ or any linear power, ≥ 0, any shape.
    looks : float
        Number of looks L > 0: every pixel is multiplied by a gamma variate of mean 1 and variance 1/L
        (L = 1: exponential, single look).
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    numpy.ndarray
        Speckled power, shape and dtype of `power`.

    Raises
    ------
    SarsplatError
        If `looks` is not positive and finite.
    """
    check_number("`looks`", looks, 0, above=True)
    return (power * rng.gamma(looks, 1 / looks, size=power.shape)).astype(power.dtype)


def check_ground(
    gamma0: float | None, terrain: Terrain | None = None, bounces: int = 1, reflectivity: float | None = None
) -> None:
    """Raise if γ⁰, terrain, number of bounces or mirror reflectivity |Γ|² of the ground are invalid or do not fit."""
    mirrors = bounces == 2 and gamma0 is not None
    fits = reflectivity is not None and 0 <= reflectivity <= 1 if mirrors else reflectivity is None  # not NaN
    raise_first(
        (
            gamma0 is not None and not 0 <= gamma0 <= _MAX_GAMMA0,
            f"`ground_gamma0` is {gamma0}; give a linear γ⁰, no dB",
        ),
        (terrain is not None and gamma0 is None, "terrain needs the γ⁰ of the ground; give `ground_gamma0`, too"),
        (bounces not in (1, 2), f"`bounces` is {bounces}; give 1, or 2 for second bounces"),
        (bounces == 2 and terrain is not None, "second bounces need flat ground; leave out `terrain`"),
        (
            not fits,
            f"`ground_reflectivity` is {reflectivity}; give |Γ|², 0 to 1, with `bounces=2` and `ground_gamma0` (0 for "
            "a dark mirror), and only then",
        ),
    )


def raise_first(*mistakes: tuple[bool, str]) -> None:
    """Raise with the message of the first mistake that is True."""
    for message in (message for mistaken, message in mistakes if mistaken):
        raise SarsplatError(message)


def check_reflectivity(
    reflectivity: Real[np.ndarray, " {faces}"] | Sequence[float] | None, faces: int
) -> Float64[np.ndarray, " {faces}"]:
    """Return factors on the law's γ⁰ as float64, 1 unless given; raise if their number or a value is invalid."""
    if reflectivity is None:
        return np.ones(faces)
    factors = np.asarray(reflectivity, dtype=np.float64)
    if factors.shape != (faces,):
        raise SarsplatError(f"reflectivity has shape {factors.shape}; give one factor for each of the {faces} faces")
    if not ((factors >= 0) & (factors <= _MAX_GAMMA0)).all():  # also catches NaN
        raise SarsplatError(f"reflectivity has a factor outside 0 to {_MAX_GAMMA0:g}; give linear factors on γ⁰")
    return factors


class ResponseSpeckle:
    """Fully developed single-look speckle on the pixels of a grid, correlated by its response."""

    def __init__(self, grid: ImageGrid) -> None:
        sizes = zip((grid.rows, grid.columns), grid.spacing_m[::-1], grid.resolution_m[::-1], strict=True)
        distances = (np.fft.fftfreq(count, 1 / count) * (spacing_m / width_m) for count, spacing_m, width_m in sizes)
        # the response is symmetric, so its transfer function is real
        weights = np.outer(*(np.fft.fft(grid.response.amplitude(distance)).real for distance in distances))
        self._weights = (weights / math.sqrt(np.mean(weights**2))).astype(np.float32)  # white noise keeps its power
        power = np.abs(fft.ifft2(self._weights)) ** 2
        self.pixels = float(power.sum() ** 2 / (power**2).sum())
        """Equivalent number of equally weighted pixels within the response."""

    def draw(self, rng: np.random.Generator) -> Complex64[np.ndarray, "rows columns"]:
        """Draw complex amplitudes of mean power 1, periodic across opposite edges."""
        noise = rng.standard_normal((2, *self._weights.shape), np.float32)  # white in frequency and in space
        weights = self._weights * np.float32(math.sqrt(noise[0].size / 2))  # of power 1 after `ifft2`
        drawn: Complex64[np.ndarray, "rows columns"] = fft.ifft2((noise[0] + 1j * noise[1]) * weights)
        return drawn

    def seen(self, scattered: Complex64[np.ndarray, "rows columns"]) -> Complex64[np.ndarray, "rows columns"]:
        """Image complex amplitudes scattered in each pixel; periodic across opposite edges."""
        imaged: Complex64[np.ndarray, "rows columns"] = fft.ifft2(fft.fft2(scattered) * self._weights)
        return imaged


def white_speckle(shape: tuple[int, int], rng: np.random.Generator) -> Complex64[np.ndarray, "rows columns"]:
    """Draw uncorrelated single-look speckle of mean power 1 as complex amplitudes; no radar has such speckle."""
    noise: Float32[np.ndarray, "rows columns 2"] = rng.standard_normal((*shape, 2), np.float32) * np.float32(0.5**0.5)
    return noise.view(np.complex64)[..., 0]
