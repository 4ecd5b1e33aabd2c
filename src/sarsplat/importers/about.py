"""Keyword arguments that importers share: the user's knowledge of scene, images and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypedDict

from sarsplat.data.header import Box, Calibration
from sarsplat.geometry import Terrain
from sarsplat.names import RadarSide, Side

Pair = tuple[float, float]


class AboutScene(TypedDict, total=False):
    """User's knowledge of the scene.

    Attributes
    ----------
    terrain : Terrain or None
        Heights of the ground that the images show; level unless given.
    target_box_m : pair of (x, y, z) or None
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Unless given, it is
        derived from the images.
    """

    terrain: Terrain | None
    target_box_m: Box | None


class AboutImages(AboutScene, total=False):
    """User's knowledge of images of any origin.

    Attributes
    ----------
    looks : float or None
        Number of looks of the speckle, 1 unless given; None without speckle.
    ground : bool
        Whether the images show the ground around the target; True unless given.
    """

    looks: float | None
    ground: bool


class AboutPictures(AboutImages, total=False):
    """User's knowledge of pictures and their table; the table's cells precede lengths, angles and orientation.

    Attributes
    ----------
    table : Path or None
        Table (CSV) with a row for each picture, of stacks for each channel; without it, the only one in the folder.
    names : str or None
        Pattern of the pictures' names that holds columns in braces and replaces the table, such as
        {azimuth}_{grazing}.png; with a slash, of their paths in the folder. Other pictures are left out.
    columns : mapping of str to str or None
        Names of the table's columns by meaning, e.g. az=aspect,graz=elev; meanings are file, azimuth or heading (of the
        flight, degrees clockwise from north), grazing or incidence, spacing, resolution (or azimuth-spacing,
        range-spacing …), split, azimuth-std, class, look (left or right), near-side, tilt, scale and offset, and of
        stacks view, baseline and polarisation. Usual names are recognised without it.
    target_class : str or None
        Class whose pictures are taken, if the table has a column of classes.
    target : str or None
        Name of the target; without it, the pictures' class, or else the folder's name.
    train_views : int or None
        Number of training views, evenly chosen; the others are test views. Without it, the column split decides, or all
        are training views.
    calibration : {"absolute", "relative"}
        Whether the power is β⁰ itself, or only up to a factor (the default).
    spacing_m : (float, float) or None
        Pixel spacing in the slant plane (azimuth, range), m; of GeoTIFFs it is that of their tags unless given. Of
        geocoded pictures, that of columns and rows on the map.
    resolution_m : (float, float) or None
        3 dB width (azimuth, range), m; without it, the pixel spacing.
    ground_range : bool
        Lengths in range are along the ground; those in the slant plane are cos(grazing) times as long.
    grazing_deg : float or None
        Grazing angle of all pictures, degrees, if the table has none.
    near : {"top", "bottom", "left", "right"} or None
        Side of the pictures that is near the radar: the top, unless a column near-side says otherwise.
    mirrored : bool
        The pictures, turned with the near side up, are mirror images; so are columns in the order of time of a radar
        that looks to the left, which a column look says picture by picture.
    look : {"right", "left"} or None
        Side of its flight to which the radar looks, if no column says it: azimuths follow from it where the table has
        headings, and to the left, columns are mirrored.
    azimuth_offset_deg : float or None
        Azimuth, degrees clockwise from the target's nose, of the table's azimuth 0: 0 unless given; of geocoded
        pictures −90, so that x points east.
    counter_clockwise : bool
        Azimuths of the table grow counter-clockwise, seen from above.
    azimuth_std_deg : float or None
        Standard deviation of the azimuths, degrees; 0 unless given.
    """

    table: str | Path | None
    names: str | None
    columns: Mapping[str, str] | None
    target_class: str | None
    target: str | None
    train_views: int | None
    calibration: Calibration
    spacing_m: Pair | None
    resolution_m: Pair | None
    ground_range: bool
    grazing_deg: float | None
    near: Side | None
    mirrored: bool
    look: RadarSide | None
    azimuth_offset_deg: float | None
    counter_clockwise: bool
    azimuth_std_deg: float | None
