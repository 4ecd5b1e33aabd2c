"""One SICD file, read by sarkit: its metadata, checked, and parts of its image."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import needed
from sarsplat.geometry.responses import GAUSSIAN, UNIFORM, Response, stated_taylor
from sarsplat.importers.files import complex_of, number_in, raise_damaged
from sarsplat.importers.sarkit_xml import Metadata, Segment, any_version, read_nitf, sarkit_errors

if TYPE_CHECKING:
    import lxml.etree
    from sarkit.sicd.projection import AdjustableParameterOffsets, MetadataParams

_MOST_PIXELS_PER_SIDE = 1_000_000

LARGEST = 1e9
"""Maximum amplitude, whose square still fits into float32."""

FARTHEST = 1e12
"""Maximum of all numbers in the metadata."""

CALIBRATIONS = ("BetaZero", "SigmaZero", "GammaZero", "RCS")
"""Quantities of `Radiometric`, in the order of preference."""

_NAMESPACE = "urn:SICD:"
_READ_AS = dict.fromkeys(("0.4.0", "0.4.1", "0.5.0", "1.0.0", "1.0.1"), "1.1.0") | {"1.2.0": "1.2.1"}
"""Versions without a schema in sarkit → the next one with it; fields in use have the same meaning."""


@dataclass(frozen=True)
class Sicd(Metadata):
    """Metadata of a SICD file, checked where they are used; places (xrow, ycol) are m from the scene centre point."""

    version: str
    """Version of the format, as the file states it."""
    projection: MetadataParams
    """Relation of pixels to places, all finite."""
    offsets: AdjustableParameterOffsets | None
    """Corrections of that relation."""
    segments: list[Segment]
    """Segments of the file with all rows of the image."""

    @cached_property
    def row(self) -> Axis:
        """Metadata of the rows."""
        return self._axis("Row")

    @cached_property
    def column(self) -> Axis:
        """Metadata of the columns."""
        return self._axis("Col")

    @cached_property
    def calibration(self) -> dict[str, Float64[np.ndarray, "m n"]]:
        """Quantity of `CALIBRATIONS` → factor to it from power, a polynomial in (xrow, ycol), m."""
        factors = {name: self._polynomial(f"Radiometric/{name}SFPoly") for name in CALIBRATIONS}
        return {name: factor for name, factor in factors.items() if factor is not None}

    @cached_property
    def pixel_type(self) -> str:
        """Type of pixels, "RE32F_IM32F", "RE16I_IM16I" or "AMP8I_PHS8I"; raises for others."""
        from sarkit.sicd import PIXEL_TYPES

        name = self.text("ImageData/PixelType")
        if name not in PIXEL_TYPES:
            raise SarsplatError(f"{self.path} has pixels of type {shown(name)}; give {', '.join(PIXEL_TYPES)}")
        return name

    @cached_property
    def amplitudes(self) -> Float64[np.ndarray, " 256"] | None:
        """Amplitudes by index of "AMP8I_PHS8I"; None for the index itself."""
        values = self._load("ImageData/AmpTable")
        if values is not None and not (np.shape(values) == (256,) and np.all((values >= 0) & (values <= LARGEST))):
            raise_damaged(self.path, "has a table of amplitudes that is not 256 numbers ≥ 0")
        return values

    @property
    def frequency_hz(self) -> float | None:
        """Centre of the processed band; None if not stated."""
        ends = [self._load(f"ImageFormation/TxFrequencyProc/{name}") for name in ("MinProc", "MaxProc")]
        if not all(isinstance(end, int | float) and 1e6 <= end <= FARTHEST for end in ends):  # also catches NaN
            return None
        return sum(map(float, ends)) / 2

    @property
    def collection(self) -> dict[str, str]:
        """Sensor, collection, mode, start and polarisation, as far as stated."""
        names = {
            "sensor": "CollectionInfo/CollectorName",
            "collection": "CollectionInfo/CoreName",
            "mode": "CollectionInfo/RadarMode/ModeType",
            "start": "Timeline/CollectStart",
            "polarization": "ImageFormation/TxRcvPolarizationProc",
        }
        return {key: text for key, name in names.items() if (text := self.text(name))}

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.projection.NumRows, self.projection.NumCols

    @property
    def axes(self) -> tuple[Axis, Axis]:
        """Rows and columns."""
        return self.row, self.column

    def pixel_of(self, place: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Convert places (xrow, ycol) to rows and columns of this file."""
        metadata = self.projection
        first = np.array([metadata.SCP_Row - metadata.FirstRow, metadata.SCP_Col - metadata.FirstCol])
        return place / [metadata.Row_SS, metadata.Col_SS] + first

    def place_of(self, pixel: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Convert rows and columns to places (xrow, ycol)."""
        return (pixel - self.pixel_of(np.zeros(2))) * [self.projection.Row_SS, self.projection.Col_SS]

    def read(self, rows: tuple[int, int], columns: tuple[int, int]) -> Complex64[np.ndarray, "rows columns"]:
        """Read amplitudes from the first row and column to before the last; raise if one is not finite or too large."""
        raw = self._stored(rows, columns)
        if self.pixel_type != "AMP8I_PHS8I":
            values = complex_of(raw).astype(np.complex64)
        else:
            amplitude = raw["amp"].astype(np.float64) if self.amplitudes is None else self.amplitudes[raw["amp"]]
            values = (amplitude * np.exp(2j * np.pi / 256 * raw["phase"])).astype(np.complex64)
        # also catches NaN
        bad = ~((np.abs(values.real) <= LARGEST) & (np.abs(values.imag) <= LARGEST))
        if bad.any():
            row, column = np.argwhere(bad)[0]
            at = f"row {rows[0] + row}, column {columns[0] + column}"
            raise_damaged(self.path, f"holds {values[row, column]:.6g} at {at}")
        return values

    def _stored(self, rows: tuple[int, int], columns: tuple[int, int]) -> np.ndarray:
        from sarkit.sicd import PIXEL_TYPES

        dtype = PIXEL_TYPES[self.pixel_type]["dtype"].newbyteorder(">")
        parts, first = [], 0
        with open_file(self.path) as file, sarkit_errors(self.path):  # the file may have become shorter
            for part in self.segments:
                stored = np.memmap(file, dtype, "r", part.offset, (part.rows, part.columns))
                parts.append(stored[max(rows[0] - first, 0) : max(rows[1] - first, 0), slice(*columns)])
                first += part.rows
            return np.concatenate(parts)

    def _load(self, name: str) -> Any:
        """Return the value of an element; None if it is missing."""
        from sarkit.sicd import XmlHelper

        with sarkit_errors(self.path):
            return XmlHelper(self.tree).load(any_version(name))

    def _number(self, name: str, least: float, most: float) -> float:
        return number_in(self.path, self._load(name), name, least, most)

    def _polynomial(self, name: str) -> Float64[np.ndarray, "m n"] | None:
        """Load a polynomial in two variables; None if it is missing."""
        value = self._load(name)
        if value is not None and not np.all(np.abs(value) <= FARTHEST):
            raise_damaged(self.path, f"has a polynomial {name} that is not finite")
        return value

    def _axis(self, name: str) -> Axis:
        """Load the metadata of rows (`Row`) or columns (`Col`)."""
        carrier = self._polynomial(f"Grid/{name}/DeltaKCOAPoly")
        window = self.text(f"Grid/{name}/WgtType/WindowName")
        sign = self._load(f"Grid/{name}/Sgn")
        if sign not in (1, -1):
            raise_damaged(self.path, f"has {shown(sign)} as Grid/{name}/Sgn, not 1 or -1")
        return Axis(
            self._number(f"Grid/{name}/SS", 1e-4, 1e4),
            self._number(f"Grid/{name}/ImpRespWid", 1e-4, 1e4),
            self._number(f"Grid/{name}/ImpRespBW", 1e-5, 1e4),
            sign,
            np.zeros((1, 1)) if carrier is None else carrier,
            self._area(f"Grid/{name}/WgtFunct"),
            "" if window == "UNKNOWN" else window,
            self._response(f"Grid/{name}/WgtType", window),
        )

    def _area(self, name: str) -> float:
        """Return the area of the power response for a peak and a bandwidth of 1, by the weights of the band."""
        weights = self._load(name)
        if weights is None:
            return 1.0
        with sarkit_errors(self.path):
            area = np.mean(np.square(weights)) / np.square(np.mean(weights))
        return number_in(self.path, float(area), name, 1.0, 1e3)

    def _response(self, name: str, window: str) -> Response:
        """Return the response of a uniform window or of a Taylor window with stated parameters; otherwise Gaussian."""
        if window == "UNIFORM":
            return UNIFORM
        stated = {item.get("name"): item.text for item in self.tree.iterfind(any_version(f"{name}/Parameter"))}
        return stated_taylor(stated.get("SLL"), stated.get("NBAR")) if window == "TAYLOR" else GAUSSIAN


def read_sicd(path: Path) -> Sicd:
    """Read the metadata of one SICD.

    Raises if it is no monostatic SICD, truncated, garbled, compressed, or needed metadata are missing or impossible.
    """
    with needed("sicd", "a SICD"):
        import sarkit.sicd.projection as projection
    with open_file(path) as file:
        tree, segments = read_nitf(path, file)
    version = modernise(path, tree)
    with sarkit_errors(path):
        metadata = projection.MetadataParams.from_xml(tree)
        offsets = projection.AdjustableParameterOffsets
        moved = offsets.from_xml(tree) if offsets.exists(tree) else None
        _check(path, metadata)
        sicd = Sicd(path, tree, version, metadata, moved, segments)
        _check_segments(sicd)
        return sicd


def _check(path: Path, metadata: MetadataParams) -> None:
    """Raise if metadata are missing, impossible or contradictory."""
    if not metadata.is_monostatic():
        raise SarsplatError(f"{path} is bistatic; only images whose radar transmits and receives are supported")
    optional = ("Optional", "None")
    for item in fields(metadata):
        value = getattr(metadata, item.name)
        if value is None and not any(word in str(item.type) for word in optional):
            raise_damaged(path, f"has no {item.name} (in sarkit's words) in its metadata")
        if isinstance(value, int | float | np.ndarray) and not np.all(np.abs(value) <= FARTHEST):  # also NaN
            problem = shown(np.asarray(value).tolist())
            raise_damaged(path, f"has the impossible {item.name} {problem} in its metadata")
    for name in ("NumRows", "NumCols"):
        number_in(path, getattr(metadata, name), name, 1, _MOST_PIXELS_PER_SIDE)
    units = np.array([metadata.uRow, metadata.uCol])
    if not np.allclose(np.linalg.norm(units, axis=1), 1, atol=1e-3) or abs(units[0] @ units[1]) > 0.99:
        raise_damaged(path, "has row and column directions that span no plane")
    if metadata.ARP_Poly.ndim != 2 or metadata.ARP_Poly.shape[1] != 3 or len(metadata.ARP_Poly) < 2:
        raise_damaged(path, "has no valid motion of its radar (Position/ARPPoly)")
    left = np.cross(metadata.ARP_SCP_COA, metadata.VARP_SCP_COA) @ (metadata.SCP - metadata.ARP_SCP_COA) > 0
    if metadata.SideOfTrack != ("L" if left else "R"):
        raise_damaged(path, f"has SideOfTrack {shown(metadata.SideOfTrack)}, but positions on the other side")


def _check_segments(sicd: Sicd) -> None:
    """Raise if image segments are compressed, or do not hold exactly the image's rows."""
    from sarkit.sicd import PIXEL_TYPES

    rows, columns = sicd.shape
    if any(part.compression != "NC" for part in sicd.segments):
        raise SarsplatError(f"{sicd.path} has compressed pixels, which no SICD may have; get it uncompressed")
    width = columns * PIXEL_TYPES[sicd.pixel_type]["bytes"]
    whole = all(part.columns == columns and part.length == part.rows * width for part in sicd.segments)
    if not whole or sum(part.rows for part in sicd.segments) != rows:
        size = f"{rows} × {columns}"
        raise_damaged(sicd.path, f"has {size} pixels of type {sicd.pixel_type}, but segments of other sizes")


@dataclass(frozen=True)
class Axis:
    """Metadata of the rows or the columns of an image."""

    spacing_m: float
    """Distance of pixels within the image plane."""
    resolution_m: float
    """3 dB width of the power response, within the image plane."""
    bandwidth: float
    """Bandwidth of the response, cycles/m."""
    sign: int
    """Sign of the exponent in the Fourier transform to spatial frequencies, 1 or −1."""
    carrier: Float64[np.ndarray, "m n"]
    """Centre of the band, cycles/m: a polynomial in (xrow, ycol), m."""
    area_per_width: float
    """Width of a rectangle with the area and the peak of the power response, times the bandwidth; 1 without weights."""
    window: str
    """Weighting of the band, as the file names it; "" if not stated."""
    response: Response
    """Response of that weighting; Gaussian if not fully stated."""

    @property
    def occupied(self) -> float:
        """Share of the sampled band that the image fills."""
        return min(self.bandwidth * self.spacing_m, 1.0)


def modernise(path: Path, tree: lxml.etree._ElementTree) -> str:
    """Change metadata of a SICD to a version with a schema in sarkit; return the file's version; raise if unknown."""
    from sarkit.sicd import VERSION_INFO

    root = tree.getroot()
    version = str(root.tag).partition("}")[0].removeprefix("{" + _NAMESPACE)
    if _NAMESPACE + version in VERSION_INFO:
        return version
    if version not in _READ_AS:
        known = sorted((*_READ_AS, *(name.removeprefix(_NAMESPACE) for name in VERSION_INFO)))
        raise SarsplatError(
            f"{path} is SICD of version {shown(version)[1:-1]}, and {', '.join(known)} are read; get it in one of these"
        )
    for element in root.iter("*"):
        element.tag = f"{{{_NAMESPACE}{_READ_AS[version]}}}{str(element.tag).rpartition('}')[2]}"
        element.attrib.pop("class", None)  # types of values, up to 0.4.1
    for name in ("Row", "Col"):  # up to 0.4.1 the name of the window alone
        weighting = root.find(f"{{*}}Grid/{{*}}{name}/{{*}}WgtType")
        if weighting is not None and len(weighting) == 0:
            window = weighting.makeelement(str(weighting.tag).replace("WgtType", "WindowName"))
            window.text, weighting.text = weighting.text, None
            weighting.append(window)
    rate = root.find("{*}RMA/{*}INCA/{*}DRateSFPoly")
    if rate is not None and rate.get("order2") is None:  # of one variable in 0.4.0
        rate.set("order2", "0")
        for coefficient in rate:
            coefficient.set("exponent2", "0")
    return version
