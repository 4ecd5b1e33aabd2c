"""Power as decibels, and decibels as grey."""

from __future__ import annotations

import io

import numpy as np
from jaxtyping import Real

DYNAMIC_DB = 40.0
"""Pictures show this range below the brightest training pixel, dB; what is darker is black."""


def to_decibels(power: np.ndarray | float, peak: float = 1.0) -> np.ndarray:
    """10·log10(power / peak), dB; powers below float32's smallest count as that, so that nothing is −inf."""
    smallest = float(np.finfo(np.float32).tiny)
    return 10 * np.log10(np.maximum(np.asarray(power, dtype=np.float64) / peak, smallest))


def decibel_png(power: Real[np.ndarray, "rows columns"], peak: float) -> bytes:
    """One image as an 8-bit grey PNG, pixel for pixel: black is −`DYNAMIC_DB` dB of `peak` or less, white is `peak`.

    Parameters
    ----------
    power : numpy.ndarray, float [rows, columns]
        β⁰, linear power.
    peak : float
        The power that is white.
    """
    from PIL import Image, PngImagePlugin

    shade = np.clip(1 + to_decibels(power, peak) / DYNAMIC_DB, 0, 1)
    text = PngImagePlugin.PngInfo()
    text.add_text("Description", f"beta0 in dB: black = -{DYNAMIC_DB:g} dB, white = 0 dB of beta0 = {peak:.6g}")
    buffer = io.BytesIO()
    Image.fromarray(np.round(255 * shade).astype(np.uint8)).save(buffer, "PNG", pnginfo=text)
    return buffer.getvalue()
