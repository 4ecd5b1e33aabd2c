"""Original MSTAR chips: Phoenix files, an ASCII header followed by magnitudes and phases.

The header is a list of `Key= value` lines. With `native_header_length= 0` the data are big-endian float32: all
magnitudes, then all phases, row by row. Files are untrusted: sizes must fit the file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Complex64, Float32

from sarsplat.arguments import checks_arguments
from sarsplat.data.csv_table import parsed
from sarsplat.data.files import open_file
from sarsplat.data.image import SarImage
from sarsplat.data.orientation import oriented
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.responses import GAUSSIAN, Response, stated_taylor
from sarsplat.importers.files import number_in, raise_damaged, whole_in

_MAGIC = b"[PhoenixHeaderVer"
_END = "[EndofPhoenixHeader]"
_LONGEST_HEADER = 65_536
_MAX_PIXELS_PER_SIDE = 4096
_LARGEST_PHASE = 100.0  # radians: any further turn has been taken off
_LARGEST = 1e9  # no magnitude and no number of a header comes near it, and its square still fits into float32


@dataclass(frozen=True)
class PhoenixChip:
    """One chip as published.

    Parameters
    ----------
    path : Path
        File, for error messages.
    header : dict of str to str
        Every `Key= value` of the header, stripped.
    magnitude : numpy.ndarray, float32 [rows, columns]
        Linear magnitude (not power) in the file's order: rows are range, near range on the side `radar_position` names.
    phase : numpy.ndarray, float32 [rows, columns]
        Radians, in the same order.
    """

    path: Path
    header: dict[str, str]
    magnitude: Float32[np.ndarray, "rows columns"]
    phase: Float32[np.ndarray, "rows columns"]

    @property
    def target_type(self) -> str:
        """E.g. `t72_tank`."""
        return self._text("TargetType")

    @property
    def serial(self) -> str:
        """Serial number of the vehicle, e.g. `132`."""
        return self._text("TargetSerNum")

    @property
    def radar_position(self) -> str:
        """Side of the array that faces the radar, e.g. `bottom`."""
        return self._text("RadarPosition")

    @property
    def target_az_deg(self) -> float:
        """TargetAz, degrees: 0 = nose toward the radar; the nose turns clockwise in the displayed chip."""
        return self._number("TargetAz")

    @property
    def measured_depression_deg(self) -> float:
        """Measured depression angle, degrees."""
        return self._number("MeasuredDepression")

    @property
    def desired_depression_deg(self) -> float:
        """Planned depression angle, degrees: the name of the collection (15, 17, 30, 45)."""
        return self._number("DesiredDepression")

    @property
    def spacing_m(self) -> tuple[float, float]:
        """Pixel spacing (cross-range, slant range), m."""
        return self._number("CrossRangePixelSpacing"), self._number("RangePixelSpacing")

    @property
    def resolution_m(self) -> tuple[float, float]:
        """3 dB width of the response (cross-range, slant range), m."""
        return self._number("CrossRange3dBWidth"), self._number("Range3dBWidth")

    @property
    def response(self) -> Response:
        """Response of the stated Taylor window, with the usual n̄; otherwise a Gaussian."""
        stated = {self.header.get(f"{axis}Weighting", "") for axis in ("Range", "CrossRange")}
        level, _, window = stated.pop().partition("dB_")
        return stated_taylor(level) if window == "Taylor" and not stated else GAUSSIAN

    @property
    def signal(self) -> Complex64[np.ndarray, "rows columns"]:
        """Complex amplitude magnitude·e^(j·phase), in the file's order."""
        return self.magnitude * np.exp(1j * self.phase)

    @property
    def image(self) -> SarImage:
        """Complex image, √β⁰ up to a factor, turned by 180° so that row 0 is near range.

        Its azimuth is −TargetAz (see `sarsplat.importers.mstar`).

        Raises
        ------
        SarsplatError
            If the radar is not at the bottom of the array.
        """
        self.require_radar_at_the_bottom()
        rows, columns = self.magnitude.shape
        view = View(-self.target_az_deg % 360, self.measured_depression_deg)
        grid = ImageGrid(rows, columns, self.spacing_m, self.resolution_m, response=self.response)
        return SarImage.of_complex(oriented(self.signal, "bottom"), view, grid)

    def require_radar_at_the_bottom(self) -> None:
        """Raise if the radar is at another side of the array."""
        if self.radar_position != "bottom":
            raise SarsplatError(f"{self.path} has RadarPosition= {self.radar_position!r}, not 'bottom'; remove it")

    def _text(self, key: str) -> str:
        value = self.header.get(key, "")
        if not value.isprintable() or not value:
            raise_damaged(self.path, f"has no readable {key} in its header")
        return value

    def _number(self, key: str) -> float:
        return number_in(self.path, parsed(self._text(key)), key, -_LARGEST, _LARGEST)


def is_phoenix(path: Path) -> bool:
    """Return whether a file begins as Phoenix files do."""
    with open_file(path) as file:
        return _begins(file.read(len(_MAGIC) + 1))


def _begins(start: bytes) -> bool:
    return start.removeprefix(b"\n").startswith(_MAGIC)  # the originals start with an empty line


@checks_arguments
def read_phoenix(path: str | Path) -> PhoenixChip:
    """Read one Phoenix file; its suffix (.000, .015, …) is a serial, not an angle.

    Raises
    ------
    SarsplatError
        If it is no Phoenix file, its header is garbled, its sizes do not fit the file (a truncated chip), it is a full
        scene rather than a chip, a field is stated twice, a magnitude is negative, absurdly large or not finite, or a
        phase is no angle.
    """
    path = Path(path)
    with open_file(path) as file:
        size = path.stat().st_size
        start = file.read(_LONGEST_HEADER)
        length, header = _parse_header(path, start)
        rows, columns = (
            whole_in(path, header.get(name, ""), name, 1, _MAX_PIXELS_PER_SIDE)
            for name in ("NumberOfRows", "NumberOfColumns")
        )
        if header.get("native_header_length") != "0":
            raise SarsplatError(
                f"{path} has a native header of {shown(header.get('native_header_length'))} bytes, "
                "so it is a scene and not a float32 chip; give target chips"
            )
        expected = length + 8 * rows * columns
        if size != expected:
            state = "truncated" if size < expected else "too long"
            raise_damaged(path, f"is {state}: {size} bytes where its header ({rows} × {columns}) asks for {expected}")
        file.seek(length)
        data = file.read(8 * rows * columns)
    magnitude, phase = np.frombuffer(data, dtype=">f4").reshape(2, rows, columns).astype(np.float32)
    for what, values, least, most in (
        ("magnitude", magnitude, 0.0, _LARGEST),
        ("phase", phase, -_LARGEST_PHASE, _LARGEST_PHASE),
    ):
        bad = ~((values >= least) & (values <= most))  # also catches NaN
        if bad.any():
            row, column = np.argwhere(bad)[0]
            value = values[row, column]
            raise_damaged(path, f"holds {what} {value:.6g} at row {row}, column {column}, not {least:g} to {most:g}")
    return PhoenixChip(path, header, magnitude, phase)


def _parse_header(path: Path, start: bytes) -> tuple[int, dict[str, str]]:
    """Return the length of the header, bytes, and its fields."""
    if not _begins(start):
        raise SarsplatError(f"{path} is not a Phoenix file: it does not start with {_MAGIC.decode()}; give originals")
    stated = re.search(rb"\nPhoenixHeaderLength= *(\d{1,9})\s", start[:256])
    length = int(stated[1]) if stated else 0
    if not 0 < length <= len(start):
        raise_damaged(path, f"declares a header of {length} bytes, but only {len(start)} could be read")
    try:
        lines = start[:length].decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise_damaged(path, f"has a header that is not ASCII text ({error})")
    if _END not in lines:
        raise_damaged(path, f"has no {_END} within the {length} bytes of its header")
    header: dict[str, str] = {}
    for key, value in (line.split("=", 1) for line in lines if "=" in line):
        if header.setdefault(key.strip(), value.strip()) != value.strip():
            raise_damaged(path, f"gives {key.strip()[:40]!r} twice with different values")
    return length, header
