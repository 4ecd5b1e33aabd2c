"""One SAR image with its view and its grid, and its picture: decibels in grey, axes in metres, near range on top."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Complex, Complex64, Float, Float32, Real, Shaped

from sarsplat.arguments import checks_arguments, expect_fields
from sarsplat.colours import POWER, colormap
from sarsplat.data.files import write_bytes
from sarsplat.errors import SarsplatError
from sarsplat.extras import needed
from sarsplat.geometry import ImageGrid, View
from sarsplat.radiometry import DYNAMIC_RANGE_DB, amplitude, to_db, white_level

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LARGEST_POWER = 1e18  # maximum β⁰ of a pixel: 180 dB is beyond any calibration, and its square fits into float32
_INCHES = 5.0  # longer side of an image in its picture
_DPI = 120


@dataclass(frozen=True)
class SarImage:
    """A SAR intensity image: β⁰, linear power, cross-section per unit slant-plane area.

    Parameters
    ----------
    power : numpy.ndarray, float32 [rows, columns]
        β⁰ (or calibrated up to one common factor), linear power, ≥ 0; row 0 is near range. Amplitude is its root.
        A torch.Tensor, such as an image of `render`, is copied to an array.
    view : View
        Direction to the radar.
    grid : ImageGrid
        Its pixels.
    signal : numpy.ndarray, complex64 [rows, columns], or None
        Complex amplitude, if the phase is known: |signal|² is the power. See `of_complex`.

    Raises
    ------
    SarsplatError
        If it is not an array of real numbers, its shape does not fit the grid, a pixel is negative, above 10¹⁸ or
        not finite, or the power is not that of the signal.
    """

    power: Real[np.ndarray, "rows columns"]
    view: View
    grid: ImageGrid
    signal: Complex64[np.ndarray, "rows columns"] | None = None

    def __post_init__(self) -> None:
        if hasattr(self.power, "detach"):  # a torch.Tensor: files of images are read without torch
            object.__setattr__(self, "power", self.power.detach().cpu().numpy())
        expect_fields(self)
        expected = (self.grid.rows, self.grid.columns)
        if self.power.shape != expected or self.power.dtype.kind not in "fiu":
            raise SarsplatError(
                f"the image is {self.power.dtype} of shape {self.power.shape}; give real power of shape {expected} "
                "(range × azimuth), or complex amplitudes to SarImage.of_complex"
            )
        check_power(self.power, "the image")
        check_signal(self.signal, self.power, "the image")

    @classmethod
    @checks_arguments
    def of_complex(cls, signal: Complex[np.ndarray, "rows columns"], view: View, grid: ImageGrid) -> Self:
        """Make an image that keeps its phase.

        Parameters
        ----------
        signal : numpy.ndarray, complex [rows, columns]
            Complex amplitude √β⁰·e^jψ, row 0 near range.
        view, grid
            See `SarImage`.

        Raises
        ------
        SarsplatError
            As for `SarImage`.
        """
        signal = as_signal(signal, "the image")
        return cls(power_of(signal), view, grid, signal)

    @property
    def amplitude(self) -> Float[np.ndarray, "rows columns"]:
        """√β⁰."""
        return amplitude(self.power)

    def db(self) -> Float[np.ndarray, "rows columns"]:
        """Return 10·log10 β⁰, dB; −inf where the power is zero."""
        return to_db(self.power, least=0.0)

    @checks_arguments
    def save(self, path: str | Path, *, dynamic_range_db: float = DYNAMIC_RANGE_DB) -> None:
        """Write its picture as PNG, whole or not at all: decibels in grey, axes in metres, a colour bar.

        Parameters
        ----------
        path : str or Path
            File to write; it must end in `.png`, and is replaced if it exists. `sarsplat.data.write_tiff` and datasets
            store numbers.
        dynamic_range_db : float
            Distance of black from white (`radiometry.white_level`), dB.

        Raises
        ------
        SarsplatError
            If matplotlib is not installed, the name does not end in `.png`, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".png":
            raise SarsplatError(f"{path} does not end in .png, the only format of pictures; choose a name that does")
        write_bytes(path, self._png(dynamic_range_db))

    @checks_arguments
    def show(self, *, dynamic_range_db: float = DYNAMIC_RANGE_DB) -> None:
        """Open a window with the picture, or show it in a notebook.

        Raises
        ------
        SarsplatError
            If matplotlib is not installed.
        """
        with needed("report", "a picture"):
            from matplotlib import pyplot
        self._draw(pyplot.figure(), dynamic_range_db)
        pyplot.show()

    def _repr_png_(self) -> bytes | None:
        """Picture for notebooks; None without matplotlib."""
        try:
            return self._png(DYNAMIC_RANGE_DB)
        except SarsplatError:
            return None

    def _png(self, dynamic_range_db: float) -> bytes:
        """Return the picture as a PNG file."""
        with needed("report", "a picture"):
            from matplotlib.figure import Figure
        figure, buffer = Figure(), io.BytesIO()
        self._draw(figure, dynamic_range_db)
        figure.savefig(buffer, format="png", dpi=_DPI)
        return buffer.getvalue()

    def _draw(self, figure: Figure, dynamic_range_db: float) -> None:
        """Draw from white, the `white_level`, to black, `dynamic_range_db` below it."""
        if not 0 < dynamic_range_db < np.inf:
            raise SarsplatError(f"a dynamic range of {dynamic_range_db} dB is not drawn; give one above 0")
        extent = self.grid.extent_m
        width, height = extent[1] - extent[0], extent[2] - extent[3]
        scale = _INCHES / max(width, height)
        figure.set_size_inches(max(width * scale, 1.5) + 1.9, max(height * scale, 1.5) + 1.0)
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        top = to_db(white_level(self.power))
        shades = axes.imshow(
            np.maximum(self.db(), top - dynamic_range_db),
            cmap=colormap(POWER),
            vmin=top - dynamic_range_db,
            vmax=top,
            extent=extent,
            interpolation="nearest",
        )
        axes.set_title(f"azimuth {self.view.azimuth_deg:g}°, grazing {self.view.grazing_deg:g}°{self.view.unusual}")
        axes.set_xlabel("azimuth, m")
        axes.set_ylabel("slant range, m")
        figure.colorbar(shades, ax=axes, label="β⁰, dB", shrink=0.9)


def check_power(power: Real[np.ndarray, "*shape"], name: str) -> None:
    """Raise SarsplatError if a pixel is negative, absurdly large or not finite; the message calls the image `name`."""
    if power.size == 0 or (power.min() >= 0 and power.max() <= _LARGEST_POWER):  # false if there is any NaN
        return
    place = tuple(int(i) for i in np.argwhere(~((power >= 0) & (power <= _LARGEST_POWER)))[0])
    raise SarsplatError(
        f"{name} holds {power[place]:.6g} at {place}; power must be finite and ≥ 0, at most {_LARGEST_POWER:g}"
    )


def as_signal(signal: Complex[np.ndarray, "*shape"], name: str) -> Complex64[np.ndarray, "*shape"]:
    """Convert complex amplitudes to complex64; raise SarsplatError if they are not complex numbers."""
    if signal.dtype.kind != "c":
        raise SarsplatError(f"{name} is of type {signal.dtype}; give an array of complex amplitudes")
    with np.errstate(over="ignore"):  # `check_power` rejects infinite pixels
        return signal.astype(np.complex64, copy=False)


def power_of(signal: Shaped[np.ndarray, "*shape"]) -> Shaped[np.ndarray, "*shape"]:
    """Return |signal|², linear power; real numbers are power and returned unchanged."""
    with np.errstate(over="ignore"):
        return np.square(signal.real) + np.square(signal.imag) if signal.dtype.kind == "c" else signal


def in_blocks(images: Shaped[Any, "*v rows columns"], factor: int) -> Shaped[Any, "*v m {factor} n {factor}"]:
    """Images (array or tensor) as blocks of `factor` × `factor` pixels, without incomplete blocks at the far ends."""
    m, n = images.shape[-2] // factor, images.shape[-1] // factor
    return images[..., : m * factor, : n * factor].reshape(*images.shape[:-2], m, factor, n, factor)


def power_of_passes(signal: Complex64[np.ndarray, "*of_signal"]) -> Float32[np.ndarray, "*shape"]:
    """Return the linear power of an image [rows, columns] or of several; of stacks [V, P, …], the mean over passes."""
    power = power_of(signal)
    return power.mean(1) if power.ndim == 4 else power


@checks_arguments
def check_signal(
    signal: Complex64[np.ndarray, "*of_signal"] | None, power: Real[np.ndarray, "*shape"], name: str, passes: int = 0
) -> None:
    """Raise SarsplatError if the power is not |signal|², of stacks its mean over `passes`, or stacks have no signal."""
    if signal is None and not passes:
        return
    shape = (power.shape[0], passes, *power.shape[1:]) if passes else power.shape
    if (
        signal is None
        or signal.dtype != np.complex64
        or signal.shape != shape
        or not np.array_equal(power_of_passes(signal), power)
    ):
        has = "None" if signal is None else f"{signal.dtype} of shape {signal.shape}"
        raise SarsplatError(
            f"the power of {name} is not the squared magnitude of its signal, {has}, which must be complex64 {shape}; "
            "make it with of_complex"
        )
