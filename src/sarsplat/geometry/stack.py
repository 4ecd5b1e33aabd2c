"""Stacks: coregistered channels of one view, interferometric passes or polarisations, and their phases."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from sarsplat.arguments import checks_arguments, expect, is_number
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.grids import ImageGrid
from sarsplat.geometry.view import View

_LEAST_WAVELENGTH, _LARGEST_WAVELENGTH = 1e-4, 100.0
_MAX_OFFSET = 0.2  # maximum offset of a pass, rad: beyond it, the passes' images differ

LOUDEST = 1e18
"""Maximum power of noise, β⁰: squares of larger ones overflow float32."""

_SEARCHED, _STEPS = 1000.0, 32  # searched elevations for ambiguities, in resolutions, and samples per resolution

_MAIN_LOBE, _AMBIGUOUS = 0.7, 0.95
"""Coherences of the passes at which the main lobe ends, and from which an elevation is ambiguous."""

POLARISATIONS = ("HH", "HV", "VH", "VV", "RR", "RL", "LR", "LL", "RH", "RV", "LH", "LV")
"""Polarisations, received and transmitted: horizontal, vertical, right and left circular."""


@dataclass(frozen=True)
class Stack:
    """Coregistered channels of a view, from almost the same direction.

    A channel is a pass of an interferometric stack, a polarisation, or a polarisation of a pass.

    The signal of pass i is y_i ∝ Σ exp(−jkR_i), R_i being the distance from its antenna: a place farther away
    has less phase. All passes have the pixels and the azimuth of the view.

    Parameters
    ----------
    wavelength_m : float
        Wavelength λ, m.
    offsets_rad : tuple of float
        Angle of each channel's antenna above the view's direction, rad: the perpendicular baseline over the range,
        b/R. The first is usually 0; all are, if channels are polarisations alone.
    transmit : {"each", "one"}
        "each" if each pass transmits and receives, k = 4π/λ; "one" if one transmits for all, k = 2π/λ.
    noise : tuple of float, optional
        Power of each channel's noise, β⁰; None if unknown.
    polarisations : tuple of str, optional
        Polarisation of each channel, received and transmitted, such as "HV"; None if all have the same.

    Raises
    ------
    SarsplatError
        If there are no channels, a number is out of range, a polarisation is unknown, or two channels are the same.
    """

    wavelength_m: float
    offsets_rad: tuple[float, ...]
    transmit: str = "each"
    noise: tuple[float, ...] | None = None
    polarisations: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        wavelength = self.wavelength_m
        if not is_number(wavelength) or not _LEAST_WAVELENGTH <= wavelength <= _LARGEST_WAVELENGTH:
            raise SarsplatError(
                f"wavelength_m is {shown(wavelength)}; give {_LEAST_WAVELENGTH:g} to {_LARGEST_WAVELENGTH:g} metres"
            )
        for name, fits, give in (
            (
                "offsets_rad",
                lambda b: is_number(b) and abs(b) <= _MAX_OFFSET,
                f"b/R in radians, at most ±{_MAX_OFFSET}",
            ),
            (
                "noise",
                lambda power: is_number(power) and 0 < power <= LOUDEST,
                f"a positive power, at most {LOUDEST:g}",
            ),
            ("polarisations", lambda name: name in POLARISATIONS, f"one of {', '.join(POLARISATIONS)}"),
        ):
            values = getattr(self, name)
            if values is None and name != "offsets_rad":
                continue
            of_each = isinstance(values, tuple | list) and len(values) == len(self.offsets_rad) > 0
            if not of_each or not all(map(fits, values)):
                raise SarsplatError(f"{name} is {shown(values)}; give for each channel {give}")
            numbers = name != "polarisations"  # JSON cannot hold numpy's
            object.__setattr__(self, name, tuple(map(float, values)) if numbers else tuple(values))
        if len(set(zip(self.offsets_rad, self.of_channels, strict=True))) < len(self.offsets_rad):
            raise SarsplatError(
                f"offsets_rad is {shown(self.offsets_rad)}, where two passes are the same; give each once, or their "
                "polarisations"
            )
        expect(Literal["each", "one"], transmit=self.transmit)
        object.__setattr__(self, "wavelength_m", float(wavelength))

    def __len__(self) -> int:
        """Number of channels."""
        return len(self.offsets_rad)

    @property
    def of_channels(self) -> tuple[str, ...]:
        """Polarisation of each channel; empty strings if all have the same."""
        return self.polarisations or ("",) * len(self.offsets_rad)

    @property
    def interferometric(self) -> bool:
        """True if phases depend on elevation alone: several offsets, and one polarisation."""
        return len(set(self.offsets_rad)) > 1 and len(set(self.of_channels)) == 1

    @property
    def polarimetric(self) -> bool:
        """True if channels have several polarisations."""
        return len(set(self.of_channels)) > 1

    @property
    def wavenumber(self) -> float:
        """Wavenumber k: phase per distance from the antenna, rad/m."""
        return (4 if self.transmit == "each" else 2) * math.pi / self.wavelength_m

    @property
    def resolution_m(self) -> float:
        """Rayleigh resolution in elevation, 2π over the span of phases per elevation, m; infinite of one pass."""
        span = self.wavenumber * float(np.ptp(self.offsets_rad))
        return 2 * math.pi / span if span else math.inf

    @property
    def ambiguous_elevation_m(self) -> float:
        """Smallest ambiguous elevation difference, m, at which the coherence of all passes is at least 95 %.

        Infinite if it exceeds 1000 resolutions, or there is one pass.
        """
        if not math.isfinite(self.resolution_m):
            return math.inf
        elevation = self.resolution_m * np.arange(0.0, _SEARCHED, 1 / _STEPS)
        phases = self.wavenumber * np.array(self.offsets_rad)
        coherence = np.abs(np.exp(1j * phases[:, None] * elevation).mean(0))
        outside = np.maximum.accumulate(coherence < _MAIN_LOBE)
        ambiguous = np.flatnonzero(outside & (coherence >= _AMBIGUOUS))
        if not len(ambiguous):
            return math.inf
        lobe = slice(ambiguous[0], ambiguous[0] + _STEPS)
        return float(elevation[lobe][coherence[lobe].argmax()])

    @checks_arguments
    def phase_vectors(self, view: View) -> Float64[np.ndarray, "p 3"]:
        """Return k (u_i − u) of each pass, rad/m, world frame, u being the view's direction.

        Its scalar product with a place x is the pass's additional phase, for y_i ∝ exp(−jkR_i) and R_i = R − u_i · x.
        """
        frame = view.look.frame
        towards = -frame[2] + np.array(self.offsets_rad)[:, None] * frame[1]
        return self.wavenumber * (towards / np.linalg.norm(towards, axis=1, keepdims=True) + frame[2])

    @checks_arguments
    def elevation_numbers(self, view: View) -> Float64[np.ndarray, " p"]:
        """Return the phase per elevation of each pass, rad/m; elevation is upwards across the line of sight.

        Of a pair, the difference κ is 2π per ambiguous elevation, and k_z = κ / (cos(grazing) cos(tilt)) the phase
        per height.
        """
        return self.phase_vectors(view) @ view.look.frame[1]

    @checks_arguments
    def plane_phases(self, view: View, grid: ImageGrid, height_m: float = 0.0) -> Float64[np.ndarray, "p rows columns"]:
        """Return the phases of a level plane in every pixel, rad; subtracting them deramps a stack.

        Parameters
        ----------
        view : View
            View of the images.
        grid : ImageGrid
            Pixels of the images.
        height_m : float
            Height of the plane, z in the world frame, m.

        Returns
        -------
        numpy.ndarray, float64 [P, rows, columns]
            A stack is deramped by exp(−j · phases), and places above the plane have the sign of their pass's offset.
        """
        look = view.look
        slant, across = np.meshgrid(grid.range_m, grid.azimuth_m, indexing="ij")
        places = np.stack([across, look.elevation_at(across, slant, height_m), slant], axis=-1) @ look.frame
        return np.moveaxis(places @ self.phase_vectors(view).T, -1, 0)
