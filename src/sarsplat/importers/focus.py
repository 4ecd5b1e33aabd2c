"""Image formation by back-projection.

The echo of one pulse at all distances, Σ_f s(f)·exp(4πj f/c·d), is a Fourier sum at uneven places; `finufft` evaluates
it to the accuracy asked for, as a direct sum would, without a range profile to interpolate in. Nothing is approximated
in the geometry: the wavefronts are spheres.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid
from sarsplat.geometry.responses import Taylor
from sarsplat.importers.apertures import Aperture
from sarsplat.importers.needed import require
from sarsplat.importers.phase_history import SPEED_OF_LIGHT

_ACCURACY = 1e-7


def focus(
    aperture: Aperture, grid: ImageGrid, weighting: Taylor
) -> Complex64[np.ndarray, "{grid.rows} {grid.columns}"]:
    """The complex image of an aperture, row 0 near range, columns along the view's x_r.

    A scatterer of amplitude A on the ground has A as its peak. Pixels are focused on the places of the ground, at the
    height of the aperture's place, that the radar frame maps to them, so that what stands there is where `View.look`
    says, without wavefront curvature. The carrier's phase, 4π f/c times slant range, is taken out, so that the spectrum
    is around zero.

    Raises
    ------
    SarsplatError
        If the grid reaches beyond what the frequencies or the pulses show unambiguously, or finufft is not installed.
    """
    require("finufft", "phase history needs", "phase-history")
    import finufft

    _check_extent(aperture, grid)
    history = aperture.history
    frequencies = history.frequencies_hz
    places = (np.arange(len(frequencies)) + 0.5) / len(frequencies) - 0.5
    cross = aperture.cross
    shares = np.abs(np.gradient(cross)) * weighting.window((cross - _middle(cross)) / aperture.extent)
    across = weighting.window(places)
    samples = history.samples * np.outer(across / across.sum(), shares / shares.sum())
    wave = 4 * math.pi / SPEED_OF_LIGHT
    pixels = ground_points(aperture, grid)
    centre = frequencies[len(frequencies) // 2]
    total = np.zeros(len(pixels), np.complex128)
    for antenna, reference, echo in zip(history.antenna_m, history.reference_m, samples.T, strict=True):
        beyond = np.linalg.norm(pixels - antenna, axis=1) - reference
        profile = finufft.nufft1d2(
            wave * history.step_hz * beyond, np.ascontiguousarray(echo), eps=_ACCURACY, isign=1, nthreads=1
        )
        total += profile * np.exp(1j * wave * centre * beyond)
    carrier = np.exp(-1j * wave * history.carrier_hz * grid.range_m)
    return (total.reshape(grid.rows, grid.columns) * carrier[:, None]).astype(np.complex64)


def ground_points(aperture: Aperture, grid: ImageGrid) -> Float64[np.ndarray, "pixels 3"]:
    """Where each pixel is on the ground, row by row, world frame, m."""
    across, away = np.pad(aperture.view.look.onto_ground, ((0, 0), (0, 1)))
    rows = grid.range_m[:, None, None] * away
    return (aperture.around_m + rows + grid.azimuth_m[None, :, None] * across).reshape(-1, 3)


def _check_extent(aperture: Aperture, grid: ImageGrid) -> None:
    corners = ground_points(aperture, grid).reshape(grid.rows, grid.columns, 3)[[0, 0, -1, -1], [0, -1, 0, -1]]
    history = aperture.history
    distance = np.linalg.norm(corners[:, None] - history.antenna_m, axis=2) - history.reference_m
    farthest, limit = float(np.abs(distance).max()), history.unambiguous_m / 2
    if farthest > limit:
        raise SarsplatError(
            f"{history.name}: the image reaches {farthest:.1f} m in range from the scene centre, but frequencies in "
            f"steps of {history.step_hz / 1e6:.3g} MHz show ±{limit:.1f} m; give a smaller --size, or an --around "
            "nearer to it"
        )
    across = grid.columns * grid.spacing_m[0]
    if across > aperture.unambiguous_m:
        raise SarsplatError(
            f"{history.name}: the image is {across:.1f} m wide, but pulses so far apart show "
            f"{aperture.unambiguous_m:.1f} m; give a smaller --size"
        )


def _middle(values: Float64[np.ndarray, " n"]) -> float:
    return float(values.min() + values.max()) / 2
