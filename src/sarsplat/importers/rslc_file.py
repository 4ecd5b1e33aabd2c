"""One RSLC file of NISAR's layout (HDF5): its metadata, and parts of its images.

`/science/LSAR/RSLC/swaths/frequencyA` holds an image for each polarisation, azimuth times × slant ranges at zero
Doppler, and `metadata/geolocationGrid` directions to the radar. Files are untrusted: links are not followed, and only
needed arrays are read.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from jaxtyping import Complex64, Float64

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.place import ecef_of_geodetic
from sarsplat.importers.files import complex_of, hdf5_array, number_in, opened_hdf5, printable, raise_damaged
from sarsplat.importers.pictures import power_or_signal

if TYPE_CHECKING:
    import h5py

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_PRODUCTS = [f"science/{band}/{product}" for band in ("LSAR", "SSAR") for product in ("RSLC", "SLC")]
_FREQUENCIES = ("frequencyA", "frequencyB")
_POLARISATIONS = ("HH", "HV", "VH", "VV")
_LOOKS = ("left", "right")
_MOST_NUMBERS = 1 << 24
_NEAREST, _ASTRAY_M = 4, 0.2
"""Number of grid points along an axis for interpolation, and maximum difference, m, to the result of one fewer."""
_WGS_84 = 4326
_AXES = ("heightAboveEllipsoid", "zeroDopplerTime", "slantRange")


@dataclass(frozen=True)
class GeolocationGrid:
    """Geolocation grid: radar directions by height above the ellipsoid (m), azimuth time (s) and slant range (m)."""

    axes: tuple[Float64[np.ndarray, " h"], Float64[np.ndarray, " t"], Float64[np.ndarray, " r"]]
    """Axes, each rising."""
    east: Float64[np.ndarray, "h t r"]
    north: Float64[np.ndarray, "h t r"]
    """East and north component of the unit vector from a place to the radar."""
    speed: Float64[np.ndarray, "h t r"]
    """Speed of the radar's image along the ground, m/s."""
    places: Float64[np.ndarray, "h t r 3"] | None = None
    """Geocentric places, m; None if the file lacks them, or has them not in longitude and latitude (WGS 84)."""

    def at(self, height_m: float, time_s: float, range_m: float) -> tuple[float, float, float]:
        """Return east, north and speed, interpolated, or extrapolated by at most one cell; raise beyond."""
        found = np.stack([self.east, self.north, self.speed], axis=-1)
        for name, line, at in zip(_AXES, self.axes, (height_m, time_s, range_m), strict=True):
            known, index = np.unique(line, return_index=True)  # rounded axes repeat values
            low = max(min(int(np.searchsorted(known, at, "right")) - 1, len(known) - 2), 0)
            share = (at - known[low]) / (known[low + 1] - known[low]) if len(known) > 1 else 0.0
            if not -1 <= share <= 2:
                raise SarsplatError(
                    f"the geolocation grid of the file has {name} from {line[0]:.8g} to {line[-1]:.8g}, but {at:.8g} "
                    "is asked for; give a `pixel`, or a `height_m`, in its range"
                )
            found = found[index[low]] * (1 - share) + found[index[min(low + 1, len(known) - 1)]] * share
        east, north, speed = map(float, found)
        return east, north, speed

    def place(self, height_m: float, time_s: float, range_m: float) -> Float64[np.ndarray, " 3"] | None:
        """Return the geocentric place, m, at a height, a time and a range; None if the grid does not determine it.

        Polynomials through the four nearest grid points along each axis interpolate; their difference to those through
        three estimates the error.
        """
        if self.places is None:
            return None
        found = [self.places, self.places]
        for line, at in zip(self.axes, (height_m, time_s, range_m), strict=True):
            if not line[0] <= at <= line[-1] or not (np.diff(line) > 0).all():  # rounded axes repeat values
                return None
            for k, count in enumerate((_NEAREST, _NEAREST - 1)):
                nearest = np.sort(np.argsort(abs(line - at), kind="stable")[:count])
                if at in line:  # exact
                    nearest = np.flatnonzero(line == at)
                elif len(nearest) < count:
                    return None
                nodes = line[nearest]
                others = [np.delete(nodes, index) for index in range(len(nodes))]
                weights = [np.prod((at - rest) / (node - rest)) for node, rest in zip(nodes, others)]  # Lagrange's
                found[k] = np.tensordot(weights, found[k][nearest], 1)
        best, other = found
        return best if np.linalg.norm(best - other) < _ASTRAY_M else None


@dataclass(frozen=True)
class Rslc:
    """Metadata of the images of one file, all finite."""

    path: Path
    group: str
    """Group of the images, such as "science/LSAR/RSLC/swaths/frequencyA"."""
    shape: tuple[int, int]
    """Number of azimuth times and slant ranges."""
    polarisations: tuple[str, ...]
    """Polarisations as the file names them: transmitted and received."""
    frequency_hz: float
    bandwidths_hz: tuple[float, float]
    """Processed bandwidths of azimuth and range."""
    times_s: tuple[float, float]
    """The first azimuth time, and their interval."""
    ranges_m: tuple[float, float]
    """The first slant range, and their interval."""
    others: dict[str, list[str]]
    """Other images of the file → their polarisations."""
    look: str
    """Side of the track on which the scene lies, "left" or "right"."""
    mission: str
    geolocation: GeolocationGrid

    def time_and_range(self, pixel: tuple[float, float]) -> tuple[float, float]:
        """Return azimuth time, s, and slant range, m, of a pixel."""
        (start, interval), (near, step) = self.times_s, self.ranges_m
        return start + interval * pixel[0], near + step * pixel[1]

    def read(
        self, polarisation: str, lines: tuple[int, int], samples: tuple[int, int]
    ) -> Complex64[np.ndarray, "lines samples"]:
        """Read amplitudes of one polarisation, from the first azimuth time and slant range to before the last.

        Raises if they cannot be read, are not complex, or one is not finite.
        """
        name = f"{self.group}/{polarisation}"
        with opened_hdf5(self.path) as file:
            image = hdf5_array(self.path, file, name)
            stored = image[slice(*lines), slice(*samples)]
        return power_or_signal(complex_of(stored), "complex", f"{self.path}: {name}")


def is_hdf5(path: Path) -> bool:
    """Return whether a file begins as HDF5 files do."""
    with open_file(path) as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def read_rslc(path: Path, images: str | None = None) -> Rslc:
    """Read the metadata of one file and of its `images`, such as "LSAR/frequencyB", the first unless given.

    Raises if it is no RSLC, damaged, or a field is missing or impossible.
    """
    if not is_hdf5(path):
        _refuse(path, "is not an HDF5 file")
    with opened_hdf5(path) as file:
        product = next((name for name in _PRODUCTS if name in file), None)
        if product is None:
            _refuse(path, f"has none of {', '.join(_PRODUCTS)}")
        groups = {
            f"{one.split('/')[1]}/{name}": group
            for one, name in itertools.product(_PRODUCTS, _FREQUENCIES)
            if (group := f"{one}/swaths/{name}") in file
        }
        if images is not None and images not in groups:
            raise SarsplatError(f"{path} has no {shown(images)}; give one of {', '.join(groups)} as `images`")
        group = groups.pop(images or next(iter(groups), ""), f"{product}/swaths/{_FREQUENCIES[0]}")
        swaths, product = group.rpartition("/")[0], group.partition("/swaths")[0]
        fields = _Fields(path, file)
        names, *others = [
            [name for name in _POLARISATIONS if f"{at}/{name}" in file] for at in (group, *groups.values())
        ]
        stored = [hdf5_array(path, file, f"{group}/{name}") for name in names]
        if not stored or any(image.size == 0 or image.id.get_storage_size() == 0 for image in stored):
            what = f"no pixels of {', '.join(names)}" if names else "no images"
            raise SarsplatError(
                f"{path} has {what} in {group}; it describes images without holding them, as examples of a format do, "
                "so give the whole product"
            )
        shapes = {image.shape for image in stored}
        if len(shapes) != 1 or any(len(shape) != 2 for shape in shapes):
            _refuse(path, f"has no images of one size in {group}, but {' and '.join(sorted(map(shown, shapes)))}")
        shape = shapes.pop()
        times, ranges = fields.line(f"{swaths}/zeroDopplerTime"), fields.line(f"{group}/slantRange")
        if (len(times), len(ranges)) != shape:
            raise_damaged(path, f"has {len(times)} azimuth times, {len(ranges)} slant ranges for {shown(shape)} pixels")
        identification = f"{product.rpartition('/')[0]}/identification"
        look = fields.text(f"{identification}/lookDirection").lower()
        if look not in _LOOKS:
            raise_damaged(path, f"says that its radar looks {shown(look)}, not left or right")
        return Rslc(
            path,
            group,
            shape,
            tuple(names),
            fields.number(f"{group}/processedCenterFrequency", 1e8, 1e12),
            (
                fields.number(f"{group}/processedAzimuthBandwidth", 1.0, 1e6),
                fields.number(f"{group}/processedRangeBandwidth", 1e4, 1e11),
            ),
            (float(times[0]), fields.number(f"{swaths}/zeroDopplerTimeSpacing", 1e-7, 1.0)),
            (float(ranges[0]), fields.number(f"{group}/slantRangeSpacing", 1e-3, 1e3)),
            dict(zip(groups, others, strict=True)),
            look,
            fields.text(f"{identification}/missionId"),
            fields.geolocation(f"{product}/metadata/geolocationGrid"),
        )


def _refuse(path: Path, problem: str) -> NoReturn:
    raise SarsplatError(f"{path} {problem}; give an RSLC in NISAR's layout")


class _Fields:
    """Checked fields of a file."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self._path, self._file = path, file

    def _array(self, name: str) -> np.ndarray:
        stored = hdf5_array(self._path, self._file, name)
        if stored.size > _MOST_NUMBERS or stored.dtype.kind not in "iuf":
            raise_damaged(self._path, f"has {stored.dtype} of shape {shown(stored.shape)} as {name}")
        values = np.asarray(stored[()], np.float64)
        if not values.size or not np.isfinite(values).all():
            raise_damaged(self._path, f"has no finite numbers as {name}")
        return values

    def number(self, name: str, least: float, most: float) -> float:
        values = self._array(name)
        return number_in(self._path, values.item() if values.size == 1 else values.tolist(), name, least, most)

    def line(self, name: str) -> Float64[np.ndarray, " n"]:
        """Read rising numbers."""
        values, step = self.axis(name)
        if step < 0 or not (np.diff(values) > 0).all():
            raise_damaged(self._path, f"has numbers that do not rise as {name}")
        return values

    def axis(self, name: str) -> tuple[Float64[np.ndarray, " n"], int]:
        """Read an axis of a grid in rising order, and its step: 1, or −1 if it falls; rounded values may repeat."""
        values = self._array(name)
        for step in (1, -1):
            if values.ndim == 1 and (np.diff(values[::step]) >= 0).all():
                return values[::step], step
        raise_damaged(self._path, f"has numbers that neither rise nor fall as {name}")

    def text(self, name: str) -> str:
        stored = hdf5_array(self._path, self._file, name)
        value = stored[()] if stored.shape == () and stored.dtype.kind in "SO" else b"?"
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
        return printable(text.strip("\0 "))

    def geolocation(self, name: str) -> GeolocationGrid:
        axes, steps = zip(*(self.axis(f"{name}/{one}") for one in _AXES), strict=True)
        values = [self._array(f"{name}/{one}") for one in ("losUnitVectorX", "losUnitVectorY", "groundTrackVelocity")]
        expected = tuple(map(len, axes))
        for value in values:
            if value.shape != expected:
                raise_damaged(
                    self._path, f"has {name} of {shown(value.shape)} values where its axes have {shown(expected)}"
                )
        rising = tuple(slice(None, None, step) for step in steps)
        places = self._places(name, axes[0][:: steps[0]], expected)
        east, north, speed = (value[rising] for value in values)
        return GeolocationGrid(
            (axes[0], axes[1], axes[2]), east, north, speed, None if places is None else places[rising]
        )

    def _places(
        self, name: str, heights: Float64[np.ndarray, " h"], shape: tuple[int, ...]
    ) -> Float64[np.ndarray, "h t r 3"] | None:
        """Return the geocentric places of a grid with these heights, in stored order; None without WGS 84."""
        try:
            if self.number(f"{name}/epsg", 0, 1e9) != _WGS_84:
                return None
            longitude, latitude = (self._array(f"{name}/{one}") for one in ("coordinateX", "coordinateY"))
        except SarsplatError:  # images are useful without it
            return None
        if not longitude.shape == latitude.shape == shape or abs(latitude).max() > 90 or abs(longitude).max() > 360:
            return None
        above = np.broadcast_to(heights[:, None, None], shape)
        return ecef_of_geodetic(np.stack([latitude, longitude, above], axis=-1))
