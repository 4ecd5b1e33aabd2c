"""A picture's numbers as power or complex amplitude, with what its file's tags say of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped

from sarsplat.errors import SarsplatError
from sarsplat.importers.bands import meaning_of
from sarsplat.importers.pictures import likely_quantity, power_or_signal, read_picture
from sarsplat.importers.rasters import Tags
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
    if (gone := tags.absent) is not None:  # what is there instead is refused nowhere, and changes no meaning
        if gone.all():
            raise SarsplatError(f"{name} holds nothing but pixels without data; leave out its row")
        pixels = np.where(gone, pixels[~gone][0] if pixels.ndim == 2 else pixels.dtype.type(0), pixels)
    if found == "complex" and (bands := meaning_of(pixels, name)):
        said.append(f"the two bands of complex pictures are {bands}")
    if (scale, offset) == (1.0, 0.0) != (tags.scale, tags.offset):
        scale, offset = tags.scale, tags.offset
        said.append(f"pixels are multiplied by {scale:g}, and {offset:g} is added, as the files say")
    image = power_or_signal(pixels, found, name, scale, offset)
    gone = np.zeros(image.shape, bool) if gone is None else gone
    return Values(np.where(gone, image.dtype.type(0), image), gone, tags, found, tuple(said))
