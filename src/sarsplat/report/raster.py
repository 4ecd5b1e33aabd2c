"""Arrays as 8-bit palette PNGs, embedded in a page as data URIs."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.colours import Palette

Picture = UInt8[np.ndarray, "rows columns"]
"""Indices of a palette."""


def indexed(values: Real[np.ndarray, "*shape"], low: float, high: float) -> UInt8[np.ndarray, "*shape"]:
    """Indices 0 to 255 of values from `low` to `high`; what lies beyond looks like the nearer end."""
    return np.round(255 * np.clip((np.asarray(values) - low) / (high - low), 0, 1)).astype(np.uint8)


def png(indices: Picture | UInt8[np.ndarray, "rows columns 3"], colours: Palette | None = None) -> bytes:
    """A PNG of the indices, in grey without a palette; or of red, green and blue."""
    from PIL import Image

    buffer = io.BytesIO()
    picture = Image.fromarray(indices)
    if colours is None:
        picture.save(buffer, "PNG", optimize=True)
        return buffer.getvalue()
    picture = picture.convert("L")
    picture.putpalette(colours[:, :3].tobytes())
    picture.save(buffer, "PNG", optimize=True, transparency=colours[:, 3].tobytes())
    return buffer.getvalue()


def data_uri(image: bytes) -> str:
    """The PNG as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(image).decode()}"


def block_means(
    images: Real[np.ndarray, "v rows columns"], factor: int
) -> Real[np.ndarray, "v fewer_rows fewer_columns"]:
    """Means over blocks of `factor` × `factor` pixels; what is left over at the far edges is cut off."""
    if factor == 1:
        return images
    count, rows, columns = len(images), images.shape[1] // factor, images.shape[2] // factor
    whole = images[:, : rows * factor, : columns * factor]
    return whole.reshape(count, rows, factor, columns, factor).mean(axis=(2, 4))
