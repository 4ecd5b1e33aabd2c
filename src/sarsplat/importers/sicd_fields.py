"""Fields of a SICD's metadata that concern its pixels: spacing, widths, weighting, pixel type, β⁰."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.responses import GAUSSIAN, UNIFORM, Response, stated_taylor

if TYPE_CHECKING:
    import lxml.etree

LARGEST = 1e9
"""No amplitude comes near it, and its square still fits into float32."""
FARTHEST = 1e12
"""Nor does any number of the metadata that is used here."""


@dataclass(frozen=True)
class Axis:
    """What the metadata say of the rows or the columns of an image."""

    spacing_m: float
    """Distance of pixels within the image plane."""
    resolution_m: float
    """3 dB width of the power response, within the image plane."""
    bandwidth: float
    """Bandwidth of the response, cycles/m."""
    sign: int
    """Sign of the exponent in the Fourier transform to spatial frequencies, 1 or −1."""
    carrier: Float64[np.ndarray, "m n"]
    """Where the band is centred, cycles/m: a polynomial in (xrow, ycol), m."""
    window: str
    """How the band was weighted, in the file's words; "" where it does not say."""
    response: Response
    """What follows from that; a Gaussian where the file does not say enough."""

    @property
    def occupied(self) -> float:
        """Share of the sampled band that the image fills."""
        return min(self.bandwidth * self.spacing_m, 1.0)


class SicdFields:
    """Single fields of the XML, each refused with a sentence if it is not what it must be."""

    def __init__(self, path: Path, tree: lxml.etree._ElementTree) -> None:
        from sarkit.sicd import XmlHelper

        self._path, self._tree, self._helper = path, tree, XmlHelper(tree)

    def _load(self, name: str) -> Any:
        return self._helper.load(_any_version(name))

    def _text(self, name: str) -> str:
        text = self._tree.findtext(_any_version(name)) or ""
        return "".join(letter if letter.isprintable() else "?" for letter in text.strip())[:80]

    def _number(self, name: str, least: float, most: float) -> float:
        value = self._load(name)
        if not isinstance(value, int | float) or not least <= value <= most:  # also catches NaN
            raise SarsplatError(
                f"{self._path} has {shown(value)} as {name}; it must be a number from {least:g} to {most:g}, so get it "
                "again"
            )
        return float(value)

    def polynomial(self, name: str) -> Float64[np.ndarray, "m n"] | None:
        """A polynomial in two variables; None where there is none."""
        value = self._load(name)
        if value is not None and not np.all(np.abs(value) <= FARTHEST):
            raise SarsplatError(f"{self._path} has a polynomial {name} that is not finite; get it again")
        return value

    def axis(self, name: str) -> Axis:
        """Rows (`Row`) or columns (`Col`)."""
        carrier = self.polynomial(f"Grid/{name}/DeltaKCOAPoly")
        window = self._text(f"Grid/{name}/WgtType/WindowName")
        sign = self._load(f"Grid/{name}/Sgn")
        if sign not in (1, -1):
            raise SarsplatError(f"{self._path} has {shown(sign)} as Grid/{name}/Sgn; it must be 1 or -1")
        return Axis(
            self._number(f"Grid/{name}/SS", 1e-4, 1e4),
            self._number(f"Grid/{name}/ImpRespWid", 1e-4, 1e4),
            self._number(f"Grid/{name}/ImpRespBW", 1e-5, 1e4),
            sign,
            np.zeros((1, 1)) if carrier is None else carrier,
            "" if window == "UNKNOWN" else window,
            self._response(f"Grid/{name}/WgtType", window),
        )

    def _response(self, name: str, window: str) -> Response:
        """The response that a window leads to, if it is one of ours and stated with its parameters."""
        if window == "UNIFORM":
            return UNIFORM
        stated = {item.get("name"): item.text for item in self._tree.iterfind(_any_version(f"{name}/Parameter"))}
        return stated_taylor(stated.get("SLL"), stated.get("NBAR")) if window == "TAYLOR" else GAUSSIAN

    def pixel_type(self) -> str:
        """One of those that sarkit knows."""
        from sarkit.sicd import PIXEL_TYPES

        name = self._text("ImageData/PixelType")
        if name not in PIXEL_TYPES:
            raise SarsplatError(f"{self._path} has pixels of type {shown(name)}; give {', '.join(PIXEL_TYPES)}")
        return name

    def amplitudes(self) -> Float64[np.ndarray, " 256"] | None:
        """The table of amplitudes, if there is one."""
        values = self._load("ImageData/AmpTable")
        if values is not None and not (np.shape(values) == (256,) and np.all((values >= 0) & (values <= LARGEST))):
            raise SarsplatError(f"{self._path} has a table of amplitudes that is not 256 numbers ≥ 0; get it again")
        return values

    def centre_frequency(self) -> float | None:
        """Of the processed band, Hz; None where the file does not say it."""
        ends = [self._load(f"ImageFormation/TxFrequencyProc/{name}") for name in ("MinProc", "MaxProc")]
        if not all(isinstance(end, int | float) and 1e6 <= end <= FARTHEST for end in ends):  # also catches NaN
            return None
        return sum(map(float, ends)) / 2

    def collection(self) -> dict[str, str]:
        """Who took it, when and how."""
        names = {
            "sensor": "CollectionInfo/CollectorName",
            "collection": "CollectionInfo/CoreName",
            "mode": "CollectionInfo/RadarMode/ModeType",
            "start": "Timeline/CollectStart",
            "polarization": "ImageFormation/TxRcvPolarizationProc",
        }
        return {key: text for key, name in names.items() if (text := self._text(name))}


def _any_version(name: str) -> str:
    """A path of elements whatever their namespace, which is that of a version."""
    return "/".join("{*}" + part for part in name.split("/"))
