"""One SICD file: its metadata, checked, and parts of its image. All that is known of the format is sarkit's."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.importers.nitf import read_sicd_xml

if TYPE_CHECKING:
    from sarkit.sicd.projection import AdjustableParameterOffsets, MetadataParams

_MOST_PIXELS_PER_SIDE = 1_000_000
_LARGEST = 1e9  # no amplitude comes near it, and its square still fits into float32
_FARTHEST = 1e12  # nor does any number of the metadata that is used here


@dataclass(frozen=True)
class Axis:
    """What the metadata say of the rows or the columns of an image.

    Parameters
    ----------
    spacing_m, resolution_m : float
        Of pixels, and 3 dB width of the power response, m, within the image plane.
    bandwidth : float
        Of the response, cycles/m.
    sign : int
        Of the exponent of the Fourier transform that leads to spatial frequencies, 1 or −1.
    carrier : numpy.ndarray, float64 [m, n]
        Where the band is centred, cycles/m: a polynomial in (xrow, ycol), m.
    window : str
        How the band was weighted, in the file's words; "" where it does not say.
    """

    spacing_m: float
    resolution_m: float
    bandwidth: float
    sign: int
    carrier: Float64[np.ndarray, "m n"]
    window: str

    @property
    def occupied(self) -> float:
        """Share of the sampled band that the image fills."""
        return min(self.bandwidth * self.spacing_m, 1.0)


@dataclass(frozen=True)
class Sicd:
    """A SICD file's metadata, as far as they are used here.

    Parameters
    ----------
    path : Path
        The file.
    projection : sarkit.sicd.projection.MetadataParams
        What relates pixels to places, all of it finite.
    offsets : sarkit.sicd.projection.AdjustableParameterOffsets or None
        Corrections of it.
    row, column : Axis
        The two directions of the image.
    pixel_type : str
        "RE32F_IM32F", "RE16I_IM16I" or "AMP8I_PHS8I".
    amplitudes : numpy.ndarray, float64 [256], or None
        What the amplitudes of the last of these stand for; None for themselves.
    beta_zero : numpy.ndarray, float64 [m, n], or None
        What power is multiplied by to be β⁰: a polynomial in (xrow, ycol), m; None if unknown.
    collection : dict of str to str
        Sensor, collection and polarisation, for people to read.
    """

    path: Path
    projection: MetadataParams
    offsets: AdjustableParameterOffsets | None
    row: Axis
    column: Axis
    pixel_type: str
    amplitudes: Float64[np.ndarray, " 256"] | None
    beta_zero: Float64[np.ndarray, "m n"] | None
    collection: dict[str, str]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.projection.NumRows, self.projection.NumCols

    def pixel_of(self, place: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Rows and columns in this file of places (xrow, ycol), m from the scene centre point."""
        known = self.projection
        first = np.array([known.SCP_Row - known.FirstRow, known.SCP_Col - known.FirstCol])
        return place / [known.Row_SS, known.Col_SS] + first

    def place_of(self, pixel: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """The inverse of `pixel_of`."""
        return (pixel - self.pixel_of(np.zeros(2))) * [self.projection.Row_SS, self.projection.Col_SS]

    def read(self, rows: tuple[int, int], columns: tuple[int, int]) -> Complex64[np.ndarray, "rows columns"]:
        """Amplitudes of a part of the image; nothing else of it is read.

        Parameters
        ----------
        rows, columns : (int, int)
            First, and the one after the last, within the image.

        Raises
        ------
        SarsplatError
            If the pixels are compressed, their segments contradict the metadata, or one is not finite or absurdly
            large.
        """
        import sarkit.sicd

        with open_file(self.path) as file:
            read_sicd_xml(self.path, file)  # the file may have changed
            with sarkit_errors(self.path):
                file.seek(0)
                reader = sarkit.sicd.NitfReader(file)
                self._check_segments(reader)
                raw, _ = reader.read_sub_image(rows[0], columns[0], rows[1], columns[1])
        if self.pixel_type == "RE32F_IM32F":
            values = raw.astype(np.complex64)
        elif self.pixel_type == "RE16I_IM16I":
            values = np.empty(raw.shape, np.complex64)
            values.real, values.imag = raw["real"], raw["imag"]
        else:
            amplitude = raw["amp"].astype(np.float64) if self.amplitudes is None else self.amplitudes[raw["amp"]]
            values = (amplitude * np.exp(2j * np.pi / 256 * raw["phase"])).astype(np.complex64)
        # also catches NaN
        bad = ~((np.abs(values.real) <= _LARGEST) & (np.abs(values.imag) <= _LARGEST))
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise SarsplatError(
                f"{self.path} holds {values[row, column]:.6g} at row {rows[0] + row}, column {columns[0] + column}; "
                f"amplitudes must be finite and at most {_LARGEST:g}, so get it again"
            )
        return values

    def _check_segments(self, reader: Any) -> None:
        """Image segments must be uncompressed and hold the image's rows, no more and no less."""
        from sarkit.sicd import PIXEL_TYPES

        size = PIXEL_TYPES[self.pixel_type]["bytes"]
        parts = [part for part in reader.jbp["ImageSegments"] if part["subheader"]["IID1"].value.startswith("SICD")]
        held = 0
        for part in parts:
            rows, columns = part["subheader"]["NROWS"].value, part["subheader"]["NCOLS"].value
            if part["subheader"]["IC"].value != "NC":
                raise SarsplatError(f"{self.path} has compressed pixels, which no SICD may have; get it uncompressed")
            if columns != self.shape[1] or part["Data"].size != rows * columns * size:
                held = -1
                break
            held += rows
        if held != self.shape[0]:
            raise SarsplatError(
                f"{self.path} says that its image has {self.shape[0]} × {self.shape[1]} pixels of type "
                f"{self.pixel_type}, but its segments hold other numbers of bytes; get it again"
            )


def read_sicd(path: Path) -> Sicd:
    """The metadata of one SICD.

    Raises
    ------
    SarsplatError
        If it is not a SICD of one radar (monostatic), truncated, garbled, or what is needed of its metadata is missing
        or impossible.
    """
    with open_file(path) as file:
        tree = read_sicd_xml(path, file)
    import sarkit.sicd.projection as projection

    with sarkit_errors(path):
        known = projection.MetadataParams.from_xml(tree)
        offsets = projection.AdjustableParameterOffsets
        moved = offsets.from_xml(tree) if offsets.exists(tree) else None
        fields_of = _Fields(path, tree)
        _check(path, known)
        return Sicd(
            path,
            known,
            moved,
            fields_of.axis("Row"),
            fields_of.axis("Col"),
            fields_of.pixel_type(),
            fields_of.amplitudes(),
            fields_of.polynomial("Radiometric/BetaZeroSFPoly"),
            fields_of.collection(),
        )


@contextmanager
def sarkit_errors(path: Path) -> Iterator[None]:
    """One sentence in place of whatever sarkit raises: it trusts its files. What it warns of and logs is kept back."""
    log = logging.getLogger("jbpy")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (SarsplatError, OSError, MemoryError):
        raise
    except Exception as error:
        told = shown(f"{type(error).__name__}: {error}")
        raise SarsplatError(f"{path} is not a valid SICD (sarkit says {told}); get it again") from error
    finally:
        log.setLevel(level)


def _check(path: Path, known: MetadataParams) -> None:
    """What must hold of the metadata before they are calculated with."""
    if not known.is_monostatic():
        raise SarsplatError(f"{path} is bistatic; only images whose radar transmits and receives are supported")
    optional = ("Optional", "None")
    for item in fields(known):
        value = getattr(known, item.name)
        if value is None and not any(word in str(item.type) for word in optional):
            raise SarsplatError(f"{path} has no {item.name} (in sarkit's words) in its metadata; get it again")
        if isinstance(value, int | float | np.ndarray) and not np.all(np.abs(value) <= _FARTHEST):  # also NaN
            told = shown(np.asarray(value).tolist())
            raise SarsplatError(f"{path} has the impossible {item.name} {told} in its metadata; get it again")
    for name in ("NumRows", "NumCols"):
        if not 1 <= getattr(known, name) <= _MOST_PIXELS_PER_SIDE:
            raise SarsplatError(f"{path} has {getattr(known, name)} as {name}; it must be 1 to {_MOST_PIXELS_PER_SIDE}")
    units = np.array([known.uRow, known.uCol])
    if not np.allclose(np.linalg.norm(units, axis=1), 1, atol=1e-3) or abs(units[0] @ units[1]) > 0.99:
        raise SarsplatError(f"{path} has row and column directions that span no plane; get it again")
    if known.ARP_Poly.ndim != 2 or known.ARP_Poly.shape[1] != 3 or len(known.ARP_Poly) < 2:
        raise SarsplatError(f"{path} does not say how its radar moved (Position/ARPPoly); get it again")
    left = np.cross(known.ARP_SCP_COA, known.VARP_SCP_COA) @ (known.SCP - known.ARP_SCP_COA) > 0
    if known.SideOfTrack != ("L" if left else "R"):
        raise SarsplatError(
            f"{path} says that its radar looks to side {shown(known.SideOfTrack)} of its track, but its position and "
            f"velocity are those of a {'left' if left else 'right'}-looking one; get it again"
        )


class _Fields:
    """Single fields of the XML."""

    def __init__(self, path: Path, tree: Any) -> None:
        from sarkit.sicd import XmlHelper

        self._path, self._tree, self._helper = path, tree, XmlHelper(tree)

    def _load(self, name: str) -> Any:
        return self._helper.load("/".join("{*}" + part for part in name.split("/")))

    def _text(self, name: str) -> str:
        text = self._tree.findtext("/".join("{*}" + part for part in name.split("/"))) or ""
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
        if value is not None and not np.all(np.abs(value) <= _FARTHEST):
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
        )

    def pixel_type(self) -> str:
        """One of those that sarkit knows."""
        from sarkit.sicd import PIXEL_TYPES

        name = self._text("ImageData/PixelType")
        if name not in PIXEL_TYPES:
            raise SarsplatError(f"{self._path} has pixels of type {shown(name)}; give {', '.join(PIXEL_TYPES)}")
        return name

    def amplitudes(self) -> Float64[np.ndarray, " 256"] | None:
        """The table of amplitudes, if there is one."""
        element = self._tree.find("{*}ImageData/{*}AmpTable")
        if element is None:
            return None
        table = np.full(256, math.nan)
        for item in element:
            index = item.get("index") or ""
            if index.isascii() and index.isdigit() and int(index[:9]) < len(table):
                table[int(index)] = float(item.text)
        if not np.all((table >= 0) & (table <= _LARGEST)):
            raise SarsplatError(f"{self._path} has a table of amplitudes that is not 256 numbers ≥ 0; get it again")
        return table

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
