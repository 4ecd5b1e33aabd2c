"""Encoding of complex amplitudes as the pixels of a chip file, decoding, and tables of labels."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex64, Float32, Shaped

from sarsplat.arguments import expect_fields
from sarsplat.data.orientation import SIDES
from sarsplat.errors import SarsplatError
from sarsplat.geometry import ImageGrid, View
from sarsplat.names import ChipFormat, ChipQuantity, ChipScale, Side

ENDINGS: dict[ChipFormat, str] = {"jpeg": ".jpg", "png": ".png", "npy": ".npy"}
"""Suffix of files, by format."""

LABELS = "labels.csv"

IMPORT_COLUMNS = (
    *("serial", "desired_depression_deg", "measured_depression_deg", "target_az_deg"),
    *("azimuth_spacing_m", "range_spacing_m", "azimuth_resolution_m", "range_resolution_m"),
)
"""Columns that `import mstar` and `import folder` ask for."""

UNUSUAL_COLUMNS = ("tilt_deg", "look")
"""Additional columns if the radar of a run squints, climbs, dives or looks to its left."""

_WHITE = 255


@dataclass(frozen=True)
class Encoding:
    """Pixels and file format of chips.

    Parameters
    ----------
    quantity : {"magnitude", "power", "complex"}
        Quantity of pixels: √β⁰, β⁰, or complex amplitudes √β⁰·e^jψ.
    scale : {"max", "fixed", "calibrated"}
        Level stored as white (8 bits) or 1: the chip's own maximum; the brightest pixel of all training images (8 bits
        clip brighter ones); or "calibrated": pixels are the runs' β⁰, not scaled.
    format : {"jpeg", "png", "npy"}
        JPEG and PNG have 8 bits; NPY float32, or complex64.
    jpeg_quality : int
        1 to 100.
    crop : int or None
        Side of the square cut out of the middle; None: all pixels.
    near : {"top", "right", "bottom", "left"}
        Side of a chip that is near the radar.

    Raises
    ------
    SarsplatError
        If a choice is unknown, or two contradict each other.
    """

    quantity: ChipQuantity = "magnitude"
    scale: ChipScale = "max"
    format: ChipFormat = "jpeg"
    jpeg_quality: int = 75
    crop: int | None = None
    near: Side = "bottom"

    def __post_init__(self) -> None:
        expect_fields(self)
        for name, value in (("quantity", "complex"), ("scale", "calibrated")):
            if getattr(self, name) == value and self.eight_bit:
                raise SarsplatError(f"{name} is {value!r}, which the 8 bits of {self.format} cannot hold; choose npy")
        if not 1 <= self.jpeg_quality <= 100:
            raise SarsplatError(f"jpeg_quality is {self.jpeg_quality}; give 1 to 100")
        if self.crop is not None and self.crop < 1:
            raise SarsplatError(f"crop is {self.crop}; give at least one pixel")

    @property
    def eight_bit(self) -> bool:
        """True if pixels are whole numbers from 0 to 255."""
        return self.format != "npy"

    def require_room(self, grid: ImageGrid, source: str) -> None:
        """Raise if the crop is larger than the images of a source."""
        least = min(grid.rows, grid.columns)
        if self.crop is not None and self.crop > least:
            raise SarsplatError(
                f"crop is {self.crop}, but the images of {source} have {grid.rows} × {grid.columns} pixels; give at "
                f"most {least}"
            )

    def require_equal_sizes(self, one: ImageGrid, name: str, other: ImageGrid, other_name: str) -> None:
        """Raise if the images of two sources have different sizes and are not cropped."""
        if self.crop is None and (one.rows, one.columns) != (other.rows, other.columns):
            raise SarsplatError(
                f"{name} has images of {one.rows} × {one.columns} pixels, but {other_name} of {other.rows} × "
                f"{other.columns}; cut all to one size, by a crop of at most "
                f"{min(one.rows, one.columns, other.rows, other.columns)}"
            )

    def size(self, grid: ImageGrid) -> tuple[int, int]:
        """Rows and columns of chips of images on a grid."""
        if self.crop is not None:
            return self.crop, self.crop
        return (grid.rows, grid.columns) if self.near in ("top", "bottom") else (grid.columns, grid.rows)

    @property
    def scale_column(self) -> str:
        """Name of the labels' column of `numbers_per_unit`."""
        return "dn_per_power" if self.quantity == "power" else "dn_per_magnitude"

    def numbers_per_unit(self, sample: Complex64[np.ndarray, "rows columns"], brightest: float) -> float:
        """Pixel value of √β⁰ = 1 in a sample, or of β⁰ = 1 if pixels are power."""
        white = self._white(np.abs(self._oriented(sample)), brightest)
        return (_WHITE if self.eight_bit else 1) / (white**2 if self.quantity == "power" else white)

    def encoded(self, sample: Complex64[np.ndarray, "rows columns"], brightest: float) -> bytes:
        """Encode a sample as the content of a file; `brightest` is the power stored as white with scale "fixed"."""
        pixels = self._pixels(sample, brightest)
        buffer = io.BytesIO()
        if self.format == "npy":
            np.save(buffer, pixels, allow_pickle=False)
        else:
            from PIL import Image

            picture = Image.fromarray(np.ascontiguousarray(pixels))
            picture.save(buffer, self.format, quality=self.jpeg_quality, compress_level=1)  # JPEG's, PNG's
        return buffer.getvalue()

    def stored(self, sample: Complex64[np.ndarray, "rows columns"], brightest: float) -> Shaped[np.ndarray, "m n"]:
        """Pixels of a sample as read back from its file: uint8, float32 or complex64."""
        if self.format != "jpeg":
            return self._pixels(sample, brightest)
        from PIL import Image

        return np.array(Image.open(io.BytesIO(self.encoded(sample, brightest))))

    def _pixels(self, sample: Complex64[np.ndarray, "rows columns"], brightest: float) -> Shaped[np.ndarray, "m n"]:
        sample = self._oriented(sample)
        magnitude = np.abs(sample)
        white = self._white(magnitude, brightest)
        scaled = (sample if self.quantity == "complex" else magnitude) / np.float32(white)
        values = scaled**2 if self.quantity == "power" else scaled
        if self.eight_bit:
            return np.rint(_WHITE * values.clip(0, 1)).astype(np.uint8)
        return np.ascontiguousarray(values)

    def _oriented(self, sample: Complex64[np.ndarray, "rows columns"]) -> Complex64[np.ndarray, "m n"]:
        """Rotate a sample to the stored orientation and crop it."""
        sample = np.rot90(sample, -SIDES.index(self.near))
        if self.crop is None:
            return sample
        top, left = ((side - self.crop) // 2 for side in sample.shape)  # after rotating, as a crop of the file would
        return sample[top : top + self.crop, left : left + self.crop]

    def _white(self, magnitude: Float32[np.ndarray, "m n"], brightest: float) -> float:
        """Magnitude stored as white (8 bits) or 1."""
        white = float(magnitude.max()) if self.scale == "max" else brightest**0.5 if self.scale == "fixed" else 1.0
        return white or 1.0


def encoded_table(rows: Iterable[dict[str, Any]], columns: Sequence[str]) -> bytes:
    """Encode rows as CSV, without cells of other columns."""
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue().encode()


def unusual_columns(views: Iterable[View]) -> tuple[str, ...]:
    """Additional columns of unusual views: `UNUSUAL_COLUMNS` if any view is unusual, else none."""
    return UNUSUAL_COLUMNS if any(view.unusual for view in views) else ()


def unusual_values(view: View) -> tuple[float | str, ...]:
    """Values of `UNUSUAL_COLUMNS`."""
    return view.tilt_deg, view.side
