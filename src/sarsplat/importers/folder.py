"""Import pictures of any origin: a folder of PNG, JPEG, TIFF, NPY or MATLAB files, and a table of their angles."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

from sarsplat.arguments import checks_arguments
from sarsplat.data.dataset import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.importers.about import AboutPictures
from sarsplat.importers.listed_images import Angles, in_range, read_pictures, write_pictures
from sarsplat.importers.map_pictures import EAST_DEG, from_map, producers_ground
from sarsplat.importers.table import read_picture_table
from sarsplat.names import Backscatter, Projection, Quantity


@checks_arguments
def import_folder(
    folder: str | Path,
    out: str | Path,
    *,
    quantity: Quantity | None = None,
    scale: float = 1.0,
    offset: float = 0.0,
    backscatter: Backscatter = "beta0",
    geocoded: Projection | None = None,
    geocoded_height_m: float = 0.0,
    overwrite: bool = False,
    **about: Unpack[AboutPictures],
) -> Dataset:
    """Import pictures (PNG, JPEG, TIFF, GeoTIFF, NPY, MATLAB) with a table (CSV) of angles.

    Parameters
    ----------
    folder : Path
        Folder of the pictures.
    out : Path
        Dataset folder to write.
    quantity : {"amplitude", "power", "db", "complex"}, optional
        Quantity that scale · pixel + offset is; without it, complex numbers are complex amplitude, whole numbers
        amplitude, and others as a column dn-per-magnitude or dn-per-power says.
    scale : float
        Factor on the pixels, e.g. 60/255 of decibels in 8 bits.
    offset : float
        Added to the pixels after that.
    backscatter : {"beta0", "sigma0", "gamma0"}
        Normalisation of the power: σ⁰ and γ⁰ become β⁰ by the factor of level ground.
    geocoded : {"level", "terrain"}, optional
        The pictures lie on a map (geocoded, north up), onto which their producer projected them from level ground, or
        from the terrain that is given. They are resampled to azimuth and slant range; azimuths of the table are then
        compass bearings of the radar, and the origin is the middle of the part that all pictures show.
    geocoded_height_m : float
        Height of that level ground, m above the ground of the scene.
    overwrite : bool
        Replace an existing dataset.
    **about
        Table, lengths, angles, orientation, looks, ground, terrain and the target's box: see `AboutPictures`.

    Raises
    ------
    SarsplatError
        If the table or a picture is missing, damaged or incomplete, several classes are shown, a path leads out of the
        folder, a number is out of range, or the output exists.

    Warns
    -----
    SarsplatWarning
        Once each, for rows without a picture, pictures without a row, and as `dataset_of` does.
    """
    folder = Path(folder)
    listed = read_picture_table(folder, about, compass=geocoded is not None)
    if listed.has_stacks:
        raise SarsplatError(
            f"{listed.path} has several rows for one view, channels of a stack; import them with `sarsplat import "
            "stack`, or give each view another name"
        )
    angles = Angles.of(about, EAST_DEG if geocoded else 0.0)
    pictures, assumptions = read_pictures(listed, about, angles, quantity, scale, offset, backscatter)
    place, layout = None, {"geocoded": geocoded}
    if geocoded:
        near = about.get("near") or next((picture.row.near for picture in pictures), None)
        for name, given in (("near", near is not None), ("mirrored", about.get("mirrored"))):
            if given:
                raise SarsplatError(f"--{name} is for pictures in range and azimuth; leave it out, or --geocoded")
        ground = producers_ground(geocoded, geocoded_height_m, about.get("terrain"))
        images, place = from_map(listed.path, pictures, ground, angles.offset_deg, assumptions)
    elif geocoded_height_m:
        raise SarsplatError("--geocoded-height is for geocoded pictures; give --geocoded level too, or leave it out")
    else:
        images, layout = in_range(listed, pictures, about, assumptions)
    source: dict[str, Any] = {
        "quantity": pictures[-1].values.quantity,
        "scale": scale,
        "offset": offset,
        **layout,
        "assumptions": [*assumptions, *angles.assumptions(listed, about, backscatter)],
    }
    return write_pictures(out, folder, listed, images, about, source, kind="folder", place=place, overwrite=overwrite)
