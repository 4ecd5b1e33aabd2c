"""One SICD file: its metadata, checked, and parts of its image. The format itself is left to sarkit."""

from __future__ import annotations

import logging
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
from sarsplat.importers.sicd_fields import FARTHEST, LARGEST, Axis, SicdFields

if TYPE_CHECKING:
    from sarkit.sicd.projection import AdjustableParameterOffsets, MetadataParams

_MOST_PIXELS_PER_SIDE = 1_000_000


@dataclass(frozen=True)
class Sicd:
    """The metadata of a SICD file that the importer uses.

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
        metadata = self.projection
        first = np.array([metadata.SCP_Row - metadata.FirstRow, metadata.SCP_Col - metadata.FirstCol])
        return place / [metadata.Row_SS, metadata.Col_SS] + first

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
        bad = ~((np.abs(values.real) <= LARGEST) & (np.abs(values.imag) <= LARGEST))
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise SarsplatError(
                f"{self.path} holds {values[row, column]:.6g} at row {rows[0] + row}, column {columns[0] + column}; "
                f"amplitudes must be finite and at most {LARGEST:g}, so get it again"
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
        metadata = projection.MetadataParams.from_xml(tree)
        offsets = projection.AdjustableParameterOffsets
        moved = offsets.from_xml(tree) if offsets.exists(tree) else None
        fields_of = SicdFields(path, tree)
        _check(path, metadata)
        return Sicd(
            path,
            metadata,
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
        problem = shown(f"{type(error).__name__}: {error}")
        raise SarsplatError(f"{path} is not a valid SICD (sarkit says {problem}); get it again") from error
    finally:
        log.setLevel(level)


def _check(path: Path, metadata: MetadataParams) -> None:
    """What must hold of the metadata before they are calculated with."""
    if not metadata.is_monostatic():
        raise SarsplatError(f"{path} is bistatic; only images whose radar transmits and receives are supported")
    optional = ("Optional", "None")
    for item in fields(metadata):
        value = getattr(metadata, item.name)
        if value is None and not any(word in str(item.type) for word in optional):
            raise SarsplatError(f"{path} has no {item.name} (in sarkit's words) in its metadata; get it again")
        if isinstance(value, int | float | np.ndarray) and not np.all(np.abs(value) <= FARTHEST):  # also NaN
            problem = shown(np.asarray(value).tolist())
            raise SarsplatError(f"{path} has the impossible {item.name} {problem} in its metadata; get it again")
    for name in ("NumRows", "NumCols"):
        if not 1 <= getattr(metadata, name) <= _MOST_PIXELS_PER_SIDE:
            raise SarsplatError(
                f"{path} has {getattr(metadata, name)} as {name}; it must be 1 to {_MOST_PIXELS_PER_SIDE}"
            )
    units = np.array([metadata.uRow, metadata.uCol])
    if not np.allclose(np.linalg.norm(units, axis=1), 1, atol=1e-3) or abs(units[0] @ units[1]) > 0.99:
        raise SarsplatError(f"{path} has row and column directions that span no plane; get it again")
    if metadata.ARP_Poly.ndim != 2 or metadata.ARP_Poly.shape[1] != 3 or len(metadata.ARP_Poly) < 2:
        raise SarsplatError(f"{path} does not say how its radar moved (Position/ARPPoly); get it again")
    left = np.cross(metadata.ARP_SCP_COA, metadata.VARP_SCP_COA) @ (metadata.SCP - metadata.ARP_SCP_COA) > 0
    if metadata.SideOfTrack != ("L" if left else "R"):
        raise SarsplatError(
            f"{path} says that its radar looks to side {shown(metadata.SideOfTrack)} of its track, but its position "
            f"and velocity are those of a {'left' if left else 'right'}-looking one; get it again"
        )
