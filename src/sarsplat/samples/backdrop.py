"""Ground of samples from a picture."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import gaussian_filter

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_pixels
from sarsplat.learning.sampler import LEARNED, UNIFORM

_GROUND_CELLS = 3.0
"""Standard deviation of the smoothing that removes the speckle of a picture of ground, resolution cells."""


def backdrop_of(ground: str | Path, grid: ImageGrid) -> str | Float32[np.ndarray, "r c"]:
    """Read the ground of samples, as `Run.sample` takes it, from a picture.

    Parameters
    ----------
    ground : str or Path
        A picture of ground, with pixels of the images' size and near range at the top: amplitudes if they are whole
        numbers, or complex; or one of the words "learned" and "uniform", which are returned.
    grid : ImageGrid
        Grid of the images: speckle is smoothed over three of its resolution cells.

    Returns
    -------
    str or numpy.ndarray, float32 [R, C]
        The word; or linear power without speckle, relative to its mean.

    Raises
    ------
    SarsplatError
        If the picture cannot be read, or is black.
    """
    if str(ground) in (LEARNED, UNIFORM):
        return str(ground)
    path = Path(ground)
    if not path.suffix:
        raise SarsplatError(f"ground is {shown(str(ground))}; give {LEARNED}, {UNIFORM} or the file of a picture")
    pixels = read_pixels(path)
    if pixels.dtype.kind == "f" and pixels.ndim == 2:
        raise SarsplatError(
            f"{path} holds {pixels.dtype} numbers, which may be amplitude or power; store amplitudes as whole numbers"
        )
    power = power_or_signal(pixels, likely_quantity(pixels, str(path)), str(path))
    power = np.abs(power) ** 2 if np.iscomplexobj(power) else power
    if not power.any():
        raise SarsplatError(f"{path} is black; give a picture of ground")
    sigma = [_GROUND_CELLS * grid.cell_m / spacing for spacing in reversed(grid.spacing_m)]
    smooth = gaussian_filter(power.astype(np.float64), sigma, mode="nearest")
    factor: Float32[np.ndarray, "r c"] = (smooth / smooth.mean()).astype(np.float32)
    return factor
