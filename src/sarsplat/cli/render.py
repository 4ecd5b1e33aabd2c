"""`sarsplat render`: render images or an animation of a run from given directions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import (
    Angles,
    Group,
    Metres,
    OptionalName,
    RunOrFile,
    angles,
    grazings,
    one_of,
    option_group,
    refuse_existing,
    run_at,
    views_from,
)
from sarsplat.cli.signals import keeping
from sarsplat.errors import SarsplatError, counted
from sarsplat.memory import required
from sarsplat.names import Swept

if TYPE_CHECKING:
    import numpy as np

    from sarsplat.geometry import ImageGrid, View
    from sarsplat.report import Look
    from sarsplat.runs import Run

_AT_A_TIME = 4  # views, between two steps of the progress
_BYTES_KEPT, _BYTES_SHOWN = 4, 16  # per pixel of an image, and of the picture drawn of it


@option_group
class Directions:
    azimuth: Angles = ()
    """Azimuths: degrees or start:stop:step (stop excluded), e.g. 30 or 0:360:15; each is combined with every grazing
    angle."""
    grazing: Angles = ()
    """Grazing angles, degrees, between 0 and 90; of a target aloft from −90. Images are tilted and look to the side as
    all those of the training; if these differ, they are level and look to the right."""
    incidence: Angles = ()
    """Incidence angles (90° − grazing), instead of grazing angles."""
    sweep: Annotated[Swept | None, one_of(Swept)] = None
    """Views along a path that ends where it began, instead of a list: all around, or up and down between the lowest
    and the highest training view. Two values of that angle are the ends between which it goes there and back; one
    value of the other angle replaces the middle of the training views' grazing angles, or their first azimuth."""
    frames: int = 90
    """Number of views of a sweep."""

    def listed(self, like: Sequence[View]) -> list[View] | None:
        """Return every azimuth at every grazing angle, with tilt and side of the views `like`; None for a sweep."""
        return None if self.sweep else views_from(self.azimuth, self.grazing, self.incidence, like=like)

    def swept(self, usual: Sequence[View]) -> list[View]:
        """Return the views of the sweep; angles that were not given are those of the views `usual`."""
        from sarsplat.report.rendered import sweep_views

        assert self.sweep is not None
        given = {"azimuth": angles(self.azimuth, "azimuth"), "grazing": grazings(self.grazing, self.incidence)}
        ends, other = given[self.sweep], "grazing" if self.sweep == "azimuth" else "azimuth"
        if len(ends) not in (0, 2) or len(given[other]) > 1:
            raise SarsplatError(
                f"--sweep {self.sweep} was given {counted(len(ends), f'{self.sweep} angle')} and {len(given[other])} "
                f"of {other}; give none or the two ends of --{self.sweep}, and at most one --{other}"
            )
        ends_deg, other_deg = (ends[0], ends[1]) if ends else None, given[other][0] if given[other] else None
        return sweep_views(self.sweep, self.frames, usual, ends_deg=ends_deg, other_deg=other_deg)


@option_group
class Pixels:
    pixels: Annotated[
        tuple[int, int] | None, tyro.conf.arg(metavar="ROWS COLUMNS", help_behavior_hint="(optional)")
    ] = None
    """Rows (slant range) and columns (azimuth) (default: as many as show what the run's images show, of which an
    animation shows the part with the target). Gaussians of a file that lie apart from all others are in images
    only if both these and the spacing are given."""
    spacing: Metres = None
    """Pixel spacing in azimuth and slant range (default: the run's)."""
    resolution: Metres = None
    """3 dB width in azimuth and slant range (default: the run's)."""


@option_group
class Pictures:
    range_db: Annotated[float, tyro.conf.arg(name="range", metavar="DB")] = 40.0
    """Dynamic range of PNGs and animations, dB below the brightest training pixel."""
    cmap: OptionalName = None
    """Colours of PNGs and animations, by matplotlib's names, such as viridis (default: gray)."""
    seconds: float = 6.0
    """Duration of an animation."""


def render(
    run: RunOrFile,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR|FILE")],
    overwrite: bool = False,
    views: Group[Directions],
    size: Group[Pixels],
    pictures: Group[Pictures],
) -> None:
    """Render a run from any direction: a folder of images, one image, or an animation.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`, or a PLY or .splat file of Gaussians.
    out
        Output path. A folder: float32 TIFFs (β⁰), PNGs (dB) and a contact sheet. A .mp4, .gif or .webp file: an
        animation. A .png or .tif file: one image.
    overwrite
        Replace an existing folder of rendered images, or an existing file of the same kind.
    views
        Views to render.
    size
        Size of images.
    pictures
        Appearance of PNGs and animations.
    """
    from sarsplat.colours import POWER
    from sarsplat.data.folders import refuse_other_kinds
    from sarsplat.report import Look
    from sarsplat.report.rendered import ANIMATIONS, FILES, SHEET, Rendered, asked_grid, require_output
    from sarsplat.tiles import tiles_kept_in

    # who gives size and number of pixels decides what they show
    done = run_at(run, strays=size.pixels is not None and size.spacing is not None)
    directions = views.listed(done.snapshot.views)
    require_output(out, views.frames if directions is None else len(directions))
    recognises = FILES.get(out.suffix.lower())
    refuse_existing(out, overwrite, marker=None if recognises else SHEET)
    if recognises is not None:
        refuse_other_kinds(out, run, recognises)
    if directions is None:
        directions = views.swept(done.snapshot.views)
        directions = directions if recognises else list(dict.fromkeys(directions))  # a folder holds each once
    look = Look(done.brightest, pictures.range_db, pictures.cmap or POWER)
    look.palette()  # an unknown colour map is rejected before the work
    grid = asked_grid(done.grid, size.pixels, size.spacing, size.resolution)
    count, pixels = len(directions), grid.rows * grid.columns
    work = f"rendering {counted(count, 'image')} of {grid.rows:,} × {grid.columns:,} pixels"
    needed = pixels * (_BYTES_KEPT * (count + min(count, _AT_A_TIME)) + _BYTES_SHOWN)
    if (announcement := required(work, needed, "ask for fewer or smaller images")) is not None:
        console.say(announcement)
    tiles = out.with_name(f".{out.name}.tiles")
    finished = f"{tiles} keeps what is finished, and the same command goes on from there"
    with keeping(lambda: finished if tiles.exists() else ""), tiles_kept_in(tiles):
        rendered = Rendered(_rendered(done, directions, grid), directions, grid, look)
        if size.pixels is None and out.suffix.lower() in ANIMATIONS:
            rendered = rendered.around_target()
        with console.busy(f"writing {out}"):
            wrote = rendered.write(out, seconds=pictures.seconds, overwrite=overwrite)
    brightest = "brightest training pixel" if run.is_dir() else "brightest pixel from all sides"
    console.say(_legend(done, look, directions[0], brightest))
    console.finish(f"{out}: {wrote}", f"look at {out if recognises else out / SHEET}")


def _legend(run: Run, look: Look, view: View, brightest: str) -> str:
    """Return a sentence about the levels of pictures and the orientation of views."""
    from sarsplat.colours import POWER
    from sarsplat.radiometry import to_db

    low, high = ("black", "white") if look.cmap == POWER else ("its lower end", "its upper end")
    level = {
        True: f"β⁰ = {to_db(look.peak):.1f} dB",
        False: "β⁰ up to an unknown factor",
        None: f"{to_db(look.peak):.1f} dB in the unit of its dataset, which is not there to ask",
    }[_absolute(run)]
    like = ""
    if unusual := view.unusual.removeprefix(", "):
        like = f"; views are {unusual}, as those of the training"
    elif any(trained.unusual for trained in run.snapshot.views):
        like = "; views are level and to the right, for those of the training differ in that"
    colours = "grey" if look.cmap == POWER else look.cmap
    return (
        f"pictures: {colours} from −{look.range_db:g} dB ({low}) to 0 dB ({high}), where 0 dB is the "
        f"{brightest}, {level}; row 0 is near range{like}"
    )


def _absolute(run: Run) -> bool | None:
    """Return whether the run's images are calibrated; None if its dataset is missing."""
    from sarsplat.data import read_json

    if run.images is not None or run.dataset_path is None:
        return run.images is not None and run.images.calibration == "absolute"
    header = run.dataset_path / "dataset.json"
    return bool(read_json(header, dict[str, Any]).get("calibration") == "absolute") if header.is_file() else None


def _rendered(run: Run, views: Sequence[View], grid: ImageGrid) -> np.ndarray:
    """Return images of the views, each different view rendered once."""
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
