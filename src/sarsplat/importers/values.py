"""A picture's numbers as power or complex amplitude, with what its file's tags say of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped

from sarsplat.errors import SarsplatError
from sarsplat.importers.bands import meaning_of
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_picture
from sarsplat.importers.tiffs import Tags, unknown
from sarsplat.names import Quantity


@dataclass(frozen=True)
class Values:
    """One picture.

    Parameters
    ----------
    image : numpy.ndarray, float32 or complex64 [rows, columns]
        Linear power, or complex amplitude; 0 where it is not known.
    unknown : numpy.ndarray, bool [rows, columns]
        Pixels that hold the value of what was not measured.
    tags : Tags
        What the file says.
    quantity : {"amplitude", "power", "db", "complex"}
        What the numbers are.
    assumptions : tuple of str
        What the file's tags and bands are taken for.
    """

    image: Shaped[np.ndarray, "rows columns"]
    unknown: Bool[np.ndarray, "rows columns"]
    tags: Tags
    quantity: Quantity
    assumptions: tuple[str, ...]


def read_values(
    path: Path, quantity: Quantity | None, scale: float, offset: float, real: Quantity | None = None
) -> Values:
    """Read a picture; `quantity` is what scale · pixel + offset is, None if that follows from the type of the numbers.

    `real` is what numbers that are not complex are, if that is known. Scale and offset of the file's own tags count
    where neither is given. Refused as by `read_picture` and `power_or_signal`, or if no pixel was measured.
    """
    pixels, tags = read_picture(path)
    name, said = str(path), []
    found = quantity or likely_quantity(pixels, name, real)
    missing = unknown(pixels, tags)
    if missing.all():
        what = "pixels that it masks" if tags.no_data is None else f"{tags.no_data}, which it says is no data"
        raise SarsplatError(f"{name} holds nothing but {what}; leave out its row")
    if missing.any():  # what is there instead is refused nowhere, and changes no meaning
        pixels = np.where(missing, pixels[~missing][0] if pixels.ndim == 2 else pixels.dtype.type(0), pixels)
    if found == "complex" and (bands := meaning_of(pixels, name)):
        said.append(f"the two bands of complex pictures are {bands}")
    if tags.white_is_zero:
        said.append("zero is white in the files, as their tags say, and numbers were turned round")
    if (scale, offset) == (1.0, 0.0) and (tags.scale, tags.offset) != (None, None):
        scale, offset = 1.0 if tags.scale is None else tags.scale, tags.offset or 0.0
        said.append(f"pixels are multiplied by {scale:g}, and {offset:g} is added, as tags of the files say")
    image = power_or_signal(pixels, found, name, scale, offset)
    gone = missing.any(axis=0 if pixels.shape[0] == 2 else 2) if pixels.ndim == 3 else missing
    image = np.where(gone, image.dtype.type(0), image)
    return Values(image, np.asarray(gone), tags, found, tuple(said))
