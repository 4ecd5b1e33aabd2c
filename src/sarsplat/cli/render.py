"""`sarsplat render`: render images or an animation of a run from given directions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import (
    Angles,
    Metres,
    OptionalName,
    RunOrFile,
    angles,
    one_of,
    refuse_existing,
    run_at,
    views_from,
)
from sarsplat.cli.ending import keeping
from sarsplat.errors import SarsplatError, counted
from sarsplat.memory import required
from sarsplat.names import Swept

if TYPE_CHECKING:
    import numpy as np

    from sarsplat.geometry import ImageGrid, View
    from sarsplat.runs import Run


_AT_A_TIME = 4  # views, between two steps of the progress
_BYTES_KEPT, _BYTES_SHOWN = 4, 16  # of a pixel: in an image, and in the picture that is being drawn of one


def render(
    run: RunOrFile,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR|FILE")],
    azimuth: Angles = (),
    grazing: Angles = (),
    incidence: Angles = (),
    sweep: Annotated[Swept | None, one_of(Swept)] = None,
    frames: int = 90,
    seconds: float = 6.0,
    pixels: Annotated[
        tuple[int, int] | None, tyro.conf.arg(metavar="ROWS COLUMNS", help_behavior_hint="(optional)")
    ] = None,
    spacing: Metres = None,
    resolution: Metres = None,
    range_db: Annotated[float, tyro.conf.arg(name="range", metavar="DB")] = 40.0,
    cmap: OptionalName = None,
    overwrite: bool = False,
) -> None:
    """Render a run from any direction: a folder of images, one image, or an animation.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`, or a PLY or .splat file of Gaussians.
    out
        What to write. A folder: float32 TIFFs (β⁰), PNGs (dB) and a contact sheet. A .mp4, .gif or .webp file: an
        animation. A .png or .tif file: one image.
    azimuth
        Azimuths: degrees or start:stop:step (stop excluded), e.g. 30 or 0:360:15; each is combined with every grazing
        angle.
    grazing
        Grazing angles, degrees, between 0 and 90; of a target aloft from −90. Images are tilted and look to the side as
        all those of the training; if these differ, they are level and look to the right.
    incidence
        Incidence angles (90° − grazing), instead of grazing angles.
    sweep
        Views along a path that ends where it began, instead of a list: all around, or up and down between the lowest
        and the highest training view. Two values of that angle are the ends between which it goes there and back; one
        value of the other angle replaces the middle of the training views' grazing angles, or their first azimuth.
    frames
        Number of views of a sweep.
    seconds
        How long an animation takes.
    pixels
        Rows (slant range) and columns (azimuth) (default: as many as show what the run's images show, of which an
        animation shows the part with the target). Gaussians of a file that lie apart from all others are in images
        only if both these and the spacing are given.
    spacing
        Pixel spacing in azimuth and slant range (default: the run's).
    resolution
        3 dB width in azimuth and slant range (default: the run's).
    range_db
        What PNGs and animations show, in dB below the brightest training pixel.
    cmap
        Colours of PNGs and animations, by matplotlib's names, such as viridis (default: gray).
    overwrite
        Replace an existing folder of rendered images, or an existing file of the same kind.
    """
    from sarsplat.colours import POWER
    from sarsplat.data.folders import refuse_other_kinds
    from sarsplat.radiometry import to_db
    from sarsplat.report.animation import ANIMATIONS
    from sarsplat.report.look import Look
    from sarsplat.report.rendered import FILES, SHEET, Rendered, asked_grid, require_distinct, require_output
    from sarsplat.tiles import tiles_kept_in

    # of the size and number of pixels, whoever gives both decides what they show
    done = run_at(run, strays=pixels is not None and spacing is not None)
    views = None if sweep else views_from(azimuth, grazing, incidence, like=done.snapshot.views)
    require_output(out, frames if views is None else len(views))
    recognises = FILES.get(out.suffix.lower())
    if views is not None and recognises is None:
        require_distinct(views)
    refuse_existing(out, overwrite, marker=None if recognises else SHEET)
    if recognises is not None:
        refuse_other_kinds(out, run, recognises)
    if views is None:
        assert sweep is not None
        views = _swept(sweep, frames, done.snapshot.views, azimuth, grazing, incidence)
        views = views if recognises else list(dict.fromkeys(views))  # a folder holds each once
    look = Look(done.brightest, range_db, cmap or POWER)
    look.palette()  # an unknown colour map is refused before the work
    grid = asked_grid(done.grid, pixels, spacing, resolution)
    _refuse_too_large(len(views), grid.rows, grid.columns)
    tiles = out.with_name(f".{out.name}.tiles")
    kept = f"{tiles} keeps what is finished, and the same command goes on from there"
    with keeping(lambda: kept if tiles.exists() else ""), tiles_kept_in(tiles):
        rendered = Rendered(_rendered(done, views, grid), views, grid, look)
        if pixels is None and out.suffix.lower() in ANIMATIONS:
            rendered = rendered.around_target()
        with console.busy(f"writing {out}"):
            wrote = rendered.write(out, seconds=seconds, overwrite=overwrite)
    ends = ("grey", "black", "white") if look.cmap == POWER else (look.cmap, "its lower end", "its upper end")
    brightest = "brightest training pixel" if run.is_dir() else "brightest pixel from all sides"
    level = {
        True: f"β⁰ = {to_db(look.peak):.1f} dB",
        False: "β⁰ up to an unknown factor",
        None: f"{to_db(look.peak):.1f} dB in the unit of its dataset, which is not there to ask",
    }[_absolute(done)]
    like = ""
    if unusual := views[0].unusual.removeprefix(", "):
        like = f"; views are {unusual}, as those of the training"
    elif any(view.unusual for view in done.snapshot.views):
        like = "; views are level and to the right, for those of the training differ in that"
    console.say(
        f"pictures: {ends[0]} from −{look.range_db:g} dB ({ends[1]}) to 0 dB ({ends[2]}), where 0 dB is the "
        f"{brightest}, {level}; row 0 is near range{like}"
    )
    console.finish(f"{out}: {wrote}", f"look at {out if recognises else out / SHEET}")


def _refuse_too_large(views: int, rows: int, columns: int) -> None:
    """Refuse more images than fit into memory, where all are kept until they are written; announce large amounts."""
    needed = rows * columns * (_BYTES_KEPT * (views + min(views, _AT_A_TIME)) + _BYTES_SHOWN)
    what = f"rendering {counted(views, 'image')} of {rows:,} × {columns:,} pixels"
    if (much := required(what, needed, "ask for fewer or smaller images")) is not None:
        console.say(much)


def _absolute(run: Run) -> bool | None:
    """Whether the run's images are β⁰ itself; None if nothing says."""
    from sarsplat.data import read_json

    if run.images is not None or run.dataset_path is None:
        return run.images is not None and run.images.calibration == "absolute"
    header = run.dataset_path / "dataset.json"
    return bool(read_json(header, dict[str, Any]).get("calibration") == "absolute") if header.is_file() else None


def _swept(
    sweep: Swept,
    frames: int,
    usual: Sequence[View],
    azimuth: Sequence[str],
    grazing: Sequence[str],
    incidence: Sequence[str],
) -> list[View]:
    """The views of a sweep, with the angles that were given."""
    from sarsplat.report.rendered import sweep_views

    if grazing and incidence:
        raise SarsplatError("both --grazing and --incidence were given, two ways to give one angle; leave out one")
    elevation = [90 - angle for angle in angles(incidence, "incidence")] if incidence else None
    given = {
        "azimuth": angles(azimuth, "azimuth") if azimuth else [],
        "grazing": elevation or (angles(grazing, "grazing") if grazing else []),
    }
    other = "grazing" if sweep == "azimuth" else "azimuth"
    if len(given[sweep]) not in (0, 2) or len(given[other]) > 1:
        raise SarsplatError(
            f"--sweep {sweep} was given {counted(len(given[sweep]), f'{sweep} angle')} and {len(given[other])} of "
            f"{other}; give none or the two ends of --{sweep}, and at most one --{other}"
        )
    ends = (given[sweep][0], given[sweep][1]) if given[sweep] else None
    return sweep_views(sweep, frames, usual, ends_deg=ends, other_deg=given[other][0] if given[other] else None)


def _rendered(run: Run, views: Sequence[View], grid: ImageGrid) -> np.ndarray:
    """Images of the views; those that come again are rendered once."""
    import numpy as np

    from sarsplat.progress import progress

    different = list(dict.fromkeys(views))
    images = np.empty((len(different), grid.rows, grid.columns), np.float32)
    with progress("rendering", len(different)) as reporter:
        for first in range(0, len(different), _AT_A_TIME):
            part = different[first : first + _AT_A_TIME]
            images[first : first + len(part)] = run.render(part, grid)
            reporter.advance(len(part))
    place = {view: number for number, view in enumerate(different)}
    return images if views == different else images[[place[view] for view in views]]
