"""`sarsplat chips`: make chips from runs, to train a classifier on."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Angles, Folder, OptionalCount, angles, refuse_existing
from sarsplat.cli.ending import keeping
from sarsplat.errors import SarsplatError, counted
from sarsplat.names import ChipFormat, ChipQuantity, ChipScale, Side, Speckle
from sarsplat.settings.config import SCATTERERS

if TYPE_CHECKING:
    from sarsplat.samples import Chips


def chips(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN …")],
    *,
    out: Folder,
    measured: bool = False,
    count: OptionalCount = None,
    azimuth: Angles = (),
    grazing: Annotated[str | None, tyro.conf.arg(metavar="LO:HI", help_behavior_hint="(optional)")] = None,
    seed: int = 0,
    quantity: ChipQuantity = "magnitude",
    scale: ChipScale = "max",
    format: ChipFormat = "jpeg",
    jpeg_quality: Annotated[int, tyro.conf.arg(metavar="Q")] = 75,
    crop: OptionalCount = None,
    near: Side = "bottom",
    ground: Annotated[str, tyro.conf.arg(metavar="{learned,uniform}|FILE")] = "learned",
    speckle: Speckle = "response",
    scatterers: Annotated[float, tyro.conf.arg(metavar="N")] = SCATTERERS,
    shard: OptionalCount = None,
    overwrite: bool = False,
) -> None:
    """Make chips to train a classifier on: samples of runs from all around, with speckle, as the radar delivers them.

    Parameters
    ----------
    runs
        Folders written by `sarsplat reconstruct`, from speckled images on one grid. A class is what a run's dataset
        says that it shows, or else the name of the run's folder.
    out
        Folder to write: a folder of each class, and labels.csv, with which `import mstar` and `import folder` read the
        chips back. Stopped, the same command goes on from what is there.
    measured
        Instead of generating, write the measured chips of datasets (or of a folder of datasets), given in place of
        runs, the same way: in OUT a folder of each set, in these one of each class.
    count
        Chips of each run (default: 360, or as many as there are azimuths).
    azimuth
        Azimuths of each run's chips in turn: degrees or start:stop:step (stop excluded). Without them, chips are spread
        evenly all around.
    grazing
        Lowest and highest grazing angle, degrees, between which each chip's is drawn, e.g. 14.5:17.5 (default: those of
        each run's training images).
    seed
        Random seed; each chip depends on it and on the chip's number alone.
    quantity
        What pixels are: √β⁰, β⁰, or complex amplitudes.
    scale
        What is white: each chip's own maximum; the brightest pixel of all training images; or nothing (calibrated): β⁰
        as the runs have it.
    format
        Files: jpeg and png of 8 bits; npy of float32, or complex64.
    jpeg_quality
        Quality of JPEGs, 1 to 100: as that of the measured chips they are mixed with.
    crop
        Side of the square that is cut out of the middle of each image, pixels (default: all of it).
    near
        Side of the chips that is near the radar; MSTAR's is the bottom.
    ground
        As the training images show it, with what is peculiar to their site; uniform, of the same mean brightness; or a
        picture of ground, near range at the top, of which parts are drawn.
    speckle
        Complex noise through the radar's response; white, without correlation; or none.
    scatterers
        How many scatterers of the target a pixel sees at a time: the fewer, the more its power is in single points;
        inf: speckle alone.
    shard
        Write WebDataset shards instead: tar files of so many chips.
    overwrite
        Replace an existing folder of chips, or an unfinished one that other options began.
    """
    from sarsplat.samples import chips as chips_of
    from sarsplat.samples import write_chips
    from sarsplat.samples.write import LABELS, MARKER

    encoding: dict[str, Any] = {
        "quantity": quantity,
        "scale": scale,
        "format": format,
        "jpeg_quality": jpeg_quality,
        "crop": crop,
        "near": near,
    }
    if measured:
        drawn = (count, azimuth, grazing, seed, ground, speckle, scatterers, shard)
        if drawn != (None, (), None, 0, "learned", "response", SCATTERERS, None):
            raise SarsplatError(
                "--measured writes chips as they were measured; leave out what says how chips are drawn (--count, "
                "--azimuth, --grazing, --seed, --ground, --speckle, --scatterers, --shard)"
            )
        _write_measured(runs, out, encoding, overwrite)
        return
    refuse_existing(out, overwrite, marker=MARKER)
    made = chips_of(
        runs,
        count=count,
        azimuths_deg=angles(azimuth, "azimuth") if azimuth else (),
        grazing_deg=_between(grazing),
        seed=seed,
        ground=ground,
        speckle=speckle,
        scatterers=scatterers,
        **encoding,
    )
    with keeping(lambda: "what is finished is kept, and the same command goes on from there"):
        write_chips(made, out, shard=shard, overwrite=overwrite, quiet=False)
    console.finish(f"{out}: {_summary(made)}; {LABELS} says what they show", _next(out, made, shard))


def _write_measured(datasets: tuple[Path, ...], out: Path, encoding: dict[str, Any], overwrite: bool) -> None:
    """Write measured chips, and say how to train on them."""
    from sarsplat.samples.encoding import Encoding
    from sarsplat.samples.measured import LABELS, MARKER, in_words, write_measured_chips

    refuse_existing(out, overwrite, marker=MARKER)
    written = write_measured_chips(datasets, out, Encoding(**encoding), overwrite=overwrite, quiet=False)
    console.finish(
        f"{out}: {in_words(written)}; {LABELS} says what they show",
        f"train on {shlex.quote(str(out / 'train'))} (torchvision's ImageFolder), half and half with generated chips "
        "(docs/how-to/chips.md)",
    )


def _between(grazing: str | None) -> tuple[float, float] | None:
    """Both ends of --grazing; one angle is both."""
    if grazing is None:
        return None
    try:
        ends = [float(part) for part in grazing.split(":")]
    except ValueError:
        ends = []
    if len(ends) not in (1, 2):
        raise SarsplatError(f"--grazing {grazing!r} is no range of angles; give two, such as 14.5:17.5")
    return ends[0], ends[-1]


def _summary(made: Chips) -> str:
    many = f" of {len(made.classes)} classes" if len(made.classes) > 1 else f" of {made.classes[0]}"
    rows, columns = made.encoding.size(made.runs[0].grid)
    return f"{counted(len(made), 'chip')}{many}, {rows} × {columns} pixels"


def _next(out: Path, made: Chips, shard: int | None) -> str:
    if shard is not None:
        return f"train on {out}/chips-*.tar, shuffled and mixed with measured chips (docs/how-to/chips.md)"
    folder = shlex.quote(str(out / made.classes[0]))
    return f"look at {folder}, and train on all mixed with measured chips (docs/how-to/chips.md)"
