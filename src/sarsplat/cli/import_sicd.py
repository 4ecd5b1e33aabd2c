"""`sarsplat import sicd`: complex images with their geometry in, a dataset out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from sarsplat.cli.arguments import (
    Folder,
    OptionalCount,
    OptionalFile,
    TargetBox,
    corners,
    heights,
    metres,
    numbers,
)
from sarsplat.cli.imported import carry_out
from sarsplat.cli.importers import Contents, Recognised, by_ending, typed_import
from sarsplat.errors import SarsplatError, counted

_NAMES = {"start": "date", "polarization": "polarisation"}
"""What else to call facts of a file."""


def command(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILES", help_behavior_hint="")],
    *,
    out: Folder,
    size: Annotated[str, tyro.conf.arg(metavar="METRES")],
    around: Annotated[str | None, tyro.conf.arg(metavar="LAT,LON[,HAE]", help_behavior_hint="(optional)")] = None,
    pixel: Annotated[str | None, tyro.conf.arg(metavar="ROW,COL", help_behavior_hint="(optional)")] = None,
    heading: Annotated[float, tyro.conf.arg(metavar="DEGREES")] = 90.0,
    target: Annotated[str, tyro.conf.arg(metavar="NAME")] = "unnamed",
    train_views: OptionalCount = None,
    stack: bool = False,
    no_ground: bool = False,
    terrain: OptionalFile = None,
    target_box: TargetBox = None,
    overwrite: bool = False,
) -> int:
    """Import SICD files: what one or several complex SAR images show of one spot.

    Parameters
    ----------
    files
        SICD files (NITF), one for each view, or the channels of one.
    out
        Dataset folder to write.
    size
        Side of the images in azimuth and slant range, e.g. 64m.
    around
        The spot, which becomes the origin: latitude and longitude, degrees, and height above the ellipsoid, m.
    pixel
        The spot as a pixel of the first file, counted from 0. With neither, the spot is its scene centre point.
    heading
        Compass heading of the scene's x axis, degrees; 90 is east.
    target
        What the images show.
    train_views
        Number of training views, evenly around; the others are test views. Without it, all are for training.
    stack
        The files, coregistered to one grid, are passes or polarisations of one view, that of the first.
    no_ground
        The images show nothing but the target.
    terrain
        Heights of the ground (GeoTIFF, metres), its middle at the scene's origin; level without it.
    target_box
        Lower and upper corner of the box that contains the target, m; x towards the nose, z up. Without it, it is
        derived from the images.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.importers import import_sicd

    place = None if around is None else numbers(around, "around", (2, 3), "47.3769,8.5417")
    spot = None if pixel is None else numbers(pixel, "pixel", (2,), "1200,800")
    return carry_out(
        import_sicd,
        files,
        out,
        doing=f"reading {counted(len(files), 'file')}",
        size_m=metres(size, "size"),
        around=place,
        pixel=None if spot is None else (spot[0], spot[1]),
        heading_deg=heading,
        target=target,
        train_views=train_views,
        stack=stack,
        ground=not no_ground,
        terrain=heights(terrain),
        target_box_m=corners(target_box),
        overwrite=overwrite,
    )


def recognise(contents: Contents) -> Recognised | None:
    """NITF files; one alone, or the first of several, is described."""
    from sarsplat.importers.nitf import is_nitf

    if contents.path.is_file() and is_nitf(contents.path):
        return _described(contents.path)
    several = by_ending(contents, (".nitf", ".ntf", ".sicd"), "sicd", "SICD")
    if several is None or not contents.path.is_dir():
        return several
    first = contents.ending_in(".nitf", ".ntf", ".sicd")[0]
    try:
        facts = {"the first": str(first), **_described(first).facts}
    except SarsplatError as error:
        facts = {"the first": str(error)}
    return replace(several, facts=facts)


def _described(path: Path) -> Recognised:
    from sarsplat.importers.sicd import require_sarkit
    from sarsplat.importers.sicd_file import read_sicd
    from sarsplat.importers.sicd_geometry import layout_around, spot_of_pixel

    require_sarkit()
    sicd = read_sicd(path)
    rows, columns = sicd.axes
    (height, width), middle = sicd.shape, (sicd.shape[0] // 2, sicd.shape[1] // 2)
    spot = spot_of_pixel(sicd, middle, heading_deg=0.0)
    layout = layout_around(sicd, spot, rows.spacing_m)
    facts = {
        "version": sicd.version,
        **{_NAMES.get(name, name): text for name, text in sicd.collection.items()},
        "where": f"{spot.latitude_deg:.6f}°, {spot.longitude_deg:.6f}°, {spot.height_m:.1f} m above the ellipsoid "
        f"(its middle, pixel {middle[0]},{middle[1]})",
        "radar": f"looks {layout.look}, {layout.distance_m / 1e3:.4g} km away at the compass bearing "
        f"{layout.view.azimuth_deg:.1f}°",
        "grazing": f"{layout.view.grazing_deg:.2f}°, slant plane tilted by {layout.tilt_deg:.1f}°",
        "size": f"{height} rows × {width} columns, {height * rows.spacing_m:.4g} m × {width * columns.spacing_m:.4g} m",
        "spacing": f"{rows.spacing_m:.4g} m × {columns.spacing_m:.4g} m",
        "resolution": f"{rows.resolution_m:.4g} m × {columns.resolution_m:.4g} m (3 dB)",
        "pixels": f"{sicd.pixel_type}, grid {sicd.projection.Grid_Type}",
        "power": "β⁰ up to one factor" if sicd.beta_zero is None else "β⁰ (BetaZeroSFPoly)",
    }
    words = ["sicd", str(path), "--pixel", f"{middle[0]},{middle[1]}", "--size", "METRES"]
    return Recognised("a SICD (complex SAR image)", facts, typed_import(*words, out=f"{path.stem}-dataset"))
