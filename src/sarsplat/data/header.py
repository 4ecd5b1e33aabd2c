"""The schema of `dataset.json`, field by field; msgspec reads and writes it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from sarsplat.geometry.place import HeightAbove, Place
from sarsplat.geometry.responses import RESPONSES
from sarsplat.threads import convert

SCHEMA = "sarsplat-dataset"
SCHEMA_VERSION = 2
SPLIT = "train|test[A-Za-z0-9.-]*"
"""Pattern of names of sets."""

Calibration = Literal["absolute", "relative"]
Pair = tuple[float, float]
Point = tuple[float, float, float]
Box = tuple[Point, Point]


def about(text: str, **limits: Any) -> msgspec.Meta:
    """Describe a field for dataset.schema.json; its limits are checked later, by the class built from the header."""
    return msgspec.Meta(description=text, extra_json_schema=limits)


class Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON object with all required fields, no unknown ones, each of its type."""


_RETIRED = about("0 or absent: older versions wrote it, and bistatic views are rejected", const=0)


class GridHeader(Strict, frozen=True, omit_defaults=True):
    """The pixel grid of all images; pairs are (azimuth, slant range)."""

    rows: Annotated[int, about("rows of every image: slant range, row 0 near", minimum=1)]
    columns: Annotated[int, about("columns of every image: azimuth, rising along the flight", minimum=1)]
    spacing_m: Annotated[Pair, about("pixel spacing, m, > 0")]
    resolution_m: Annotated[Pair, about("3 dB width of the power response, m, > 0")]
    center_m: Annotated[Pair, about("position of the middle of the images, from the scene's origin, m")]
    response: Annotated[
        dict[str, Any] | None,
        about(
            "shape of the power response: its kind and settings, such as "
            '{"kind": "taylor", "level_db": 35, "sidelobes": 4}; null for a Gaussian',
            required=["kind"],
            properties={"kind": {"enum": [*RESPONSES]}},
        ),
    ] = None


class StackHeader(Strict, frozen=True, omit_defaults=True):
    """Passes of an interferometric stack, coregistered to one image."""

    wavelength_m: Annotated[float, about("λ, m, > 0")]
    offsets_rad: Annotated[
        tuple[float, ...], about("elevation of each pass's antenna above the view's direction, b/R, rad", minItems=1)
    ]
    transmit: Annotated[
        Literal["each", "one"], about("transmitting antennas: one for each pass (k = 4π/λ) or one for all (2π/λ)")
    ]
    noise: Annotated[tuple[float, ...] | None, about("power of each pass's noise, β⁰; null if unknown")] = None
    polarisations: Annotated[
        tuple[str, ...] | None,
        about('received and transmitted polarisation of each pass, such as "HV"; null if all are equal'),
    ] = None


class TurnHeader(Strict, frozen=True, omit_defaults=True):
    """The rotation of a target aloft by which a frame was made."""

    axis: Annotated[Point, about("rotation axis, counter-clockwise seen from its tip, target's frame")]
    angle_deg: Annotated[
        float, about("rotation since the beginning of the pass, degrees", minimum=-36000, maximum=36000)
    ]
    axis_std_deg: Annotated[
        float, about("standard deviation of the axis in both directions across it, degrees", minimum=0, maximum=10)
    ] = 0.0
    rate_std: Annotated[float, about("relative standard deviation of the rate of rotation", minimum=0, maximum=0.2)] = (
        0.0
    )
    name: Annotated[str, about("name of the pass; its frames share axis, deviations and name")] = ""


class ViewHeader(Strict, frozen=True, omit_defaults=True):
    """One image: its file and its view."""

    file: Annotated[str, about("path of the TIFF inside the folder, different for each image")]
    azimuth_deg: Annotated[
        float,
        about("φ, direction to the radar, degrees clockwise from +x seen from above", minimum=-3600, maximum=3600),
    ]
    grazing_deg: Annotated[
        float,
        about(
            "θ, elevation of the radar above the horizon, degrees; below 0 only aloft",
            exclusiveMinimum=-90,
            exclusiveMaximum=90,
        ),
    ]
    split: Annotated[
        str, about('"train", or a test set: a name that starts with "test", such as "test-17"', pattern=f"^({SPLIT})$")
    ]
    name: Annotated[str, about("name of the image, such as the path of the measured chip")]
    azimuth_std_deg: Annotated[
        float | None, about("standard deviation of the azimuth, degrees, at most 10; null if it is known exactly")
    ] = None  # of 0: msgspec leaves out a default only if it is the very object
    tilt_deg: Annotated[
        float,
        about(
            "τ, elevation of the azimuth axis above the horizon, degrees; beyond ±89 only aloft",
            minimum=-90,
            maximum=90,
        ),
    ] = 0.0
    side: Annotated[Literal["right", "left"], about("side of the flight track to which the radar looks")] = "right"
    aloft: Annotated[
        bool, about("true if the target is in free space: no ground at z = 0, and the radar may be below")
    ] = False
    apart_deg: Annotated[float | msgspec.UnsetType, _RETIRED] = msgspec.UNSET
    apart_towards_deg: Annotated[float | msgspec.UnsetType, _RETIRED] = msgspec.UNSET
    stretch: Annotated[
        float, about("length along azimuth in the image for each metre of a target aloft", minimum=0.5, maximum=2)
    ] = 1.0
    turn: Annotated[
        TurnHeader | None, about("rotation of a target aloft by which the frame was made; null if unknown")
    ] = None
    stack: Annotated[
        StackHeader | None,
        about("passes of a stack, one page of the TIFF each, in this order; null if it is a single image"),
    ] = None


class PlaceHeader(Strict, frozen=True):
    """Position and orientation of the scene on earth."""

    latitude_deg: Annotated[float, about("latitude of the origin, degrees north, WGS 84", minimum=-90, maximum=90)]
    longitude_deg: Annotated[float, about("longitude of the origin, degrees east", minimum=-360, maximum=360)]
    height_m: Annotated[float, about("height of the origin above the level height_above, m", minimum=-1e5, maximum=1e5)]
    x_towards_deg: Annotated[float, about("compass bearing of the x axis, degrees clockwise from true north")]
    height_above: Annotated[HeightAbove, about("zero level of the height")]
    datum: Annotated[Literal["WGS 84"], about("datum of latitude and longitude")]

    @property
    def place(self) -> Place:
        """The `Place` with these values; raises if they are out of range."""
        return Place(self.latitude_deg, self.longitude_deg, self.height_m, self.x_towards_deg, self.height_above)


def place_header(place: Place | None) -> PlaceHeader | msgspec.UnsetType:
    """Convert a place for a header."""
    return msgspec.UNSET if place is None else convert(place.as_dict(), PlaceHeader)


class DatasetHeader(Strict, frozen=True, omit_defaults=True):
    """A dataset without its pixels. Fields of later versions have defaults, which are left out of the fingerprint."""

    schema: Annotated[str, about("kind of file", const=SCHEMA)]
    schema_version: Annotated[int, about("version of this schema", const=SCHEMA_VERSION)]
    quantity: Annotated[Literal["beta0"], about("physical quantity: cross-section per area of the slant plane")]
    unit: Annotated[Literal["linear power"], about("unit of the power")]
    target: Annotated[str, about("name of the target")]
    calibration: Annotated[Calibration, about("β⁰ itself, or β⁰ up to an unknown common factor")]
    looks: Annotated[float | None, about("looks of the speckle in the images, > 0; null without speckle")]
    ground: Annotated[bool, about("true if the images show the ground around the target")]
    score_margin: Annotated[
        int, about("pixels left out on each side of an image when speckled images are scored; 0 for none", minimum=0)
    ]
    target_box_m: Annotated[
        Box | None, about("lower and upper corner of the box that contains the target; null to find it in the images")
    ]
    protocol: Annotated[str | None, about('"paper" or "mstar" for views and grid of that experiment, otherwise null')]
    truth_mesh: Annotated[str | None, about('"truth.ply", the mesh of the target (m, its own frame), or null')]
    grid: Annotated[GridHeader, about("pixels of every image")]
    source: Annotated[
        dict[str, Any],
        about("origin and assumptions of the images, for people; may be empty (programs use it to orient masks)"),
    ]
    views: Annotated[tuple[ViewHeader, ...], about("the images, at least one of them in the set train", minItems=1)]
    clean_tests: Annotated[bool, about("true if the test images have no speckle although the training images do")] = (
        False
    )
    pixels: Annotated[
        Literal["power", "complex"],
        about("float32 linear power, or complex64 amplitudes: their squared magnitude, of stacks its mean, is power"),
    ] = "power"
    terrain: Annotated[
        str | None, about('"terrain.tif", heights of the ground (GeoTIFF, m), or null where it is level at z = 0')
    ] = None
    place: Annotated[PlaceHeader | msgspec.UnsetType, about("position of the origin on earth; absent if unknown")] = (
        msgspec.UNSET
    )
