"""From where the radar saw each picture, by what its row of the table says."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import View
from sarsplat.importers.measured_image import view_of
from sarsplat.importers.table import ListedPicture, PictureTable

_AGREE_DEG, _LEAST_DEG = 5.0, 1.0
"""By how much an azimuth may miss what a heading says: maps' norths, small squints. The second is a grazing angle."""


@dataclass(frozen=True)
class Angles:
    """What is said of the angles of all pictures."""

    offset_deg: float
    """What the azimuth 0 of the table is here, clockwise from the target's nose."""
    counter_clockwise: bool
    """Whether azimuths of the table run that way."""
    grazing_deg: float | None
    """Where the table says none."""

    def clockwise(self, azimuth_deg: float) -> float:
        """An azimuth of the table, as the table counts otherwise."""
        return -azimuth_deg if self.counter_clockwise else azimuth_deg


def view_of_picture(listed: PictureTable, picture: ListedPicture, angles: Angles, left: bool) -> View:
    """The view of a picture, which is mirrored if the radar looks to the `left`: then it is one that looks right."""
    name = f"{listed.path}: {picture.name}"
    tilt = picture.tilt_deg or 0.0
    tilt = -tilt if left else tilt
    grazing = angles.grazing_deg if picture.grazing_deg is None else picture.grazing_deg
    if grazing is None:
        raise SarsplatError(
            f"{listed.path} does not say from what grazing angle {picture.name} is; name the column with "
            "--columns grazing=NAME (or incidence=NAME), or give one angle for all with --grazing"
        )
    return view_of(name, angles.offset_deg + _azimuth(listed, picture, angles), grazing, tilt)


def _azimuth(listed: PictureTable, picture: ListedPicture, angles: Angles) -> float:
    """The direction to the radar, degrees clockwise, as the table counts: of a flight's heading, to its side."""
    heading = picture.heading_deg
    if picture.azimuth_deg is not None:
        azimuth = angles.clockwise(picture.azimuth_deg)
        if heading is not None and picture.looks_left is not None:
            _refuse_other_heading(listed, picture, azimuth, _across(heading, picture.looks_left))
        return azimuth
    column = shown(listed.columns["heading"])
    if picture.looks_left is None:
        raise SarsplatError(
            f"{listed.path} has no azimuths but headings of the flight ({column}), and does not say to which side "
            f"{picture.name} looks; give it with --look or a column look (right or left), or name a column of azimuths "
            "with --columns azimuth=NAME"
        )
    if angles.counter_clockwise:
        raise SarsplatError(
            f"{listed.path} has headings ({column}), which run clockwise; leave out --counter-clockwise, or name a "
            "column of azimuths with --columns azimuth=NAME"
        )
    assert heading is not None  # a column of either is there
    return _across(heading, picture.looks_left)


def _across(heading_deg: float, looks_left: bool) -> float:
    """The direction to the radar from what it sees at right angles to its flight."""
    return heading_deg + (90 if looks_left else -90)


def _refuse_other_heading(listed: PictureTable, picture: ListedPicture, azimuth: float, across: float) -> None:
    """Of a table with both, the radar must be where the flight's heading and its side have it, or ahead or behind by
    its squint: above level flight, an azimuth axis that is tilted by τ is squinted by atan(tan τ / sin θ).
    """
    grazing = math.radians(min(max(picture.grazing_deg or 0.0, _LEAST_DEG), 90.0))
    squint = math.degrees(math.atan(math.tan(math.radians(picture.tilt_deg or 0.0)) / math.sin(grazing)))
    if abs((azimuth - across + 180) % 360 - 180) > _AGREE_DEG + abs(squint):
        side = "left" if picture.looks_left else "right"
        raise SarsplatError(
            f"{listed.path}: {picture.name} has an azimuth of {picture.azimuth_deg:g}°, but a radar with the heading "
            f"{picture.heading_deg:g}° that looks to its {side} is in the direction {across % 360:g}°; say which holds "
            "with --columns azimuth=NAME or --columns heading=NAME, or mend the table"
        )
