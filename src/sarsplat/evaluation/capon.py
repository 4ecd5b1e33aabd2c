"""Capon's method, for comparison: each pixel's elevations are the peaks of its spectrum over elevation."""

import numpy as np
from jaxtyping import Complex128, Float64
from scipy.ndimage import uniform_filter

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, Stack, View

_WINDOW = 3  # pixels along each side over which covariances are averaged, as reconstructions do
_LOADING = 0.05  # diagonal loading relative to the mean power; covariances of few looks have no inverse
_STEPS = 40  # steps of elevation per resolution

_MIN_PEAK, _MIN_SNR = 0.3, 2.0
"""Minimum height of a peak, relative to the pixel's highest one and to the noise in the spectrum."""

_DARK = 1e-6  # power relative to the brightest pixel below which peaks are rounding errors


@checks_arguments
def capon_points(dataset: Dataset, low_m: float, high_m: float) -> Float64[np.ndarray, "p 3"]:
    """Reconstruct points from the training stacks, all directions together.

    Covariances are deramped by level phases and averaged over 3 × 3 pixels; every peak of the spectrum above 0.3 of the
    pixel's highest and twice the noise is a point, interpolated by a parabola.

    Parameters
    ----------
    dataset : Dataset
        Dataset of interferometric stacks.
    low_m, high_m : float
        Range of heights of the peaks, m.

    Returns
    -------
    numpy.ndarray, float64 [P, 3]
        World frame, m.

    Raises
    ------
    SarsplatError
        If the dataset has no interferometric stacks.
    """
    train = dataset.select("train")
    if train.signal is None or not train.interferometric:
        raise SarsplatError("Capon's method needs interferometric stacks; this dataset has single images")
    return np.concatenate(
        [
            _of_stack(signal, view, train.grid, stack, low_m, high_m)
            for signal, view, stack in zip(train.signal, train.views, train.stacks, strict=True)
        ]
    )


def _of_stack(
    signal: np.ndarray, view: View, grid: ImageGrid, stack: Stack, low_m: float, high_m: float
) -> Float64[np.ndarray, "p 3"]:
    look = view.look
    deramped = np.moveaxis(signal * np.exp(-1j * stack.plane_phases(view, grid)), 0, -1)
    products: Complex128[np.ndarray, "rows columns p p"] = deramped[..., :, None] * deramped[..., None, :].conj()
    sample = uniform_filter(products, (_WINDOW, _WINDOW, 1, 1))
    power = np.trace(sample, axis1=2, axis2=3).real / len(stack)
    loaded = sample + (_LOADING * power + 1e-9 * power.max())[..., None, None] * np.eye(len(stack))
    step = stack.resolution_m / _STEPS
    lowest, highest = low_m / look.height_per_elevation, high_m / look.height_per_elevation
    above = np.arange(lowest, highest + step, step)  # elevation above the level plane
    steering = np.exp(1j * stack.elevation_numbers(view)[:, None] * above)
    inverse = np.linalg.inv(loaded)
    spectrum = 1 / np.einsum("ps,rcpq,qs->rcs", steering.conj(), inverse, steering, optimize=True).real
    noise = 0.0 if stack.noise is None else _MIN_SNR * float(np.mean(stack.noise)) / len(stack)
    inner = spectrum[..., 1:-1]
    peaks = (inner > spectrum[..., :-2]) & (inner > spectrum[..., 2:]) & (inner > noise)
    peaks &= inner > _MIN_PEAK * spectrum.max(-1, keepdims=True)
    peaks &= (power > _DARK * power.max())[..., None]
    row, column, at = np.nonzero(peaks)
    before, here, after = (np.log(spectrum[row, column, at + k]) for k in (0, 1, 2))
    curvature = before - 2 * here + after
    shift = np.divide(0.5 * (before - after), curvature, out=np.zeros_like(here), where=curvature < 0)
    slant, across = grid.range_m[row], grid.azimuth_m[column]
    elevation = look.elevation_at(across, slant, 0.0) + above[at + 1] + step * shift
    return np.column_stack([across, elevation, slant]) @ look.frame
