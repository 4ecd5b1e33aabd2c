"""`sarsplat render`: a run and a direction in, images out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sarsplat.cli import console
from sarsplat.cli.arguments import Angles, Folder, RunFolder, refuse_existing, views_from
from sarsplat.errors import SarsplatError, counted

if TYPE_CHECKING:
    from sarsplat.geometry import View

_SHEET = "contact-sheet.png"


def render(
    run: RunFolder,
    *,
    out: Folder,
    azimuth: Angles,
    grazing: Angles = (),
    incidence: Angles = (),
    overwrite: bool = False,
) -> None:
    """Render a run from any direction: float32 TIFFs (β⁰), PNGs (dB) and a contact sheet.

    Parameters
    ----------
    run
        Folder written by `sarsplat reconstruct`.
    out
        Folder to write.
    azimuth
        Azimuths: degrees or start:stop:step (stop excluded), e.g. 30 or 0:360:15; each is combined with every grazing
        angle.
    grazing
        Grazing angles, degrees, between 0 and 90.
    incidence
        Incidence angles (90° − grazing), instead of grazing angles.
    overwrite
        Replace an existing folder of rendered images.
    """
    from sarsplat.data import new_folder, write_bytes, write_power_tiff
    from sarsplat.report import contact_sheet, decibel_png
    from sarsplat.report.decibels import DYNAMIC_DB, to_decibels
    from sarsplat.rivals import open_run

    views = views_from(azimuth, grazing, incidence)
    if len({_name(view) for view in views}) < len(views):
        raise SarsplatError("two of the views are the same to within a millionth of a degree; give each view once")
    done = open_run(run)
    refuse_existing(out, overwrite, marker=_SHEET)
    peak = done.brightest
    with console.busy(f"rendering {counted(len(views), 'view')}"):
        images = done.render(views)
        with new_folder(out, overwrite, marker=_SHEET) as folder:
            for view, image in zip(views, images, strict=True):
                description = (
                    f"rendered SAR image, beta0 in linear power; row 0 is near range; "
                    f"azimuth {view.azimuth_deg:.6g} deg, grazing {view.grazing_deg:.6g} deg"
                )
                write_power_tiff(folder / f"{_name(view)}.tif", image, description)
                write_bytes(folder / f"{_name(view)}.png", decibel_png(image, peak))
            write_bytes(folder / _SHEET, contact_sheet(images, views, done.grid, peak))
    console.say(
        f"PNGs: grey from −{DYNAMIC_DB:g} dB (black) to 0 dB (white), where 0 dB is the brightest training pixel, "
        f"β⁰ = {float(to_decibels(peak)):.1f} dB; row 0 is near range"
    )
    console.finish(f"{out}: {counted(len(views), 'image')} as TIFF and PNG, and {_SHEET}", f"look at {out / _SHEET}")


def _name(view: View) -> str:
    """E.g. az030_gr17.5: sorts by azimuth."""

    def digits(angle: float, width: int) -> str:
        return f"{angle:0{width}.6f}".rstrip("0").rstrip(".")

    return f"az{digits(view.azimuth_deg, 10)}_gr{digits(view.grazing_deg, 9)}"
