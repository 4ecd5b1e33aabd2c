"""`sarsplat export`: write a run as one file for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Angles, Metres, one_of, refuse_existing, run_at, views_from
from sarsplat.errors import SarsplatError
from sarsplat.names import Colour, Content

if TYPE_CHECKING:
    from sarsplat.geometry import View

_TERRAIN = (".tif", ".tiff")


def export(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|PLY|TIF")],
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    *,
    format: Annotated[Content | None, one_of(Content)] = None,
    colour: Annotated[Colour | None, one_of(Colour, hint="(default: db)")] = None,
    crs: Annotated[str | None, tyro.conf.arg(metavar="EPSG:NUMBER", help_behavior_hint="(default: UTM)")] = None,
    pixel: Metres = None,
    azimuth: Angles = (),
    grazing: Angles = (),
    incidence: Angles = (),
    overwrite: bool = False,
) -> None:
    """Write Gaussians, points, a mesh or a map of a run to one file for other programs.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`, or a PLY, .splat or .glb file of Gaussians; for layover and shadow
        also a GeoTIFF of heights.
    file
        File to write. Its ending decides the format: .ply (Gaussians, unless --format says otherwise); .splat
        (Gaussians); .glb (a mesh, or Gaussians by --format gaussians); .obj, .stl (a mesh); .las, .laz (points);
        .tif (a map of the surface from above: dsm.tif, gamma0.tif or layover-shadow.tif, or by any name with
        --format); .geojson (the outline of points on a map).
    format
        Content of a .ply, .glb or .tif file. gaussians: in the layout of 3D Gaussian splatting; points: of the surface,
        metres, with normals and γ⁰; mesh: triangles through the points, with normals and γ⁰ at the vertices; dsm:
        height of the surface, m; gamma0: its γ⁰, linear; layover-shadow: 0 neither, 1 shadow, 2 layover, 3 both, 255
        unknown.
    colour
        Colour of Gaussians in viewers: γ⁰ in decibels as grey (db), or the height as colours.
    crs
        Coordinate system of .las, .laz and .tif files, projected and in metres, of a georeferenced run.
        Other files of such a run get FILE.place.json, their georeference.
    pixel
        Size of a map's pixels (default: a resolution cell).
    azimuth
        Azimuth of the radar, degrees, for layover and shadow.
    grazing
        Grazing angle of the radar, degrees, for layover and shadow.
    incidence
        Incidence angle (90° − grazing), instead of the grazing angle.
    overwrite
        Replace an existing file of the same kind.
    """
    from sarsplat import exports
    from sarsplat.data.folders import refuse_other_kinds

    kind, holds = exports.format_of(file, format)
    view = _view(azimuth, grazing, incidence)
    refuse_existing(file, overwrite)
    if run.suffix.lower() in _TERRAIN and not run.is_dir():
        if view is None or holds != "layover-shadow" or colour or crs or pixel is not None:
            raise SarsplatError(
                f"a GeoTIFF of heights, {run}, gives only layover and shadow from one direction; write "
                f"`export {run} layover-shadow.tif --azimuth DEG --grazing DEG`"
            )
        refuse_other_kinds(file, run, kind.recognises)
        with console.busy(f"writing {file}"):
            written = exports.export_terrain(run, file, view)
    else:
        # no pixel or mesh is as fine as the target and as wide as outliers
        done = run_at(run, strays=holds == "gaussians")
        console.warn_if_beaten(done.metrics)
        refuse_other_kinds(file, run, kind.recognises)
        with console.busy(f"writing {file}"):
            written = exports.export(done, file, format, colour=colour, crs=crs, pixel_m=pixel, view=view)
    if written.beside:
        console.say(f"wrote {written.beside}")
    console.finish(f"{file}: {written.summary}", f"open {file} with {written.opened_with}")


def _view(azimuth: Angles, grazing: Angles, incidence: Angles) -> "View | None":
    """Return the direction of the options, None without; raise if there are several."""
    if not (azimuth or grazing or incidence):
        return None
    views = views_from(azimuth, grazing, incidence)
    if len(views) > 1:
        raise SarsplatError(f"{len(views)} directions were given; a map of layover and shadow is of one")
    return views[0]
