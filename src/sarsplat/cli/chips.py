"""`sarsplat chips`: generate chips from runs to train a classifier."""

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import (
    Angles,
    Folder,
    Group,
    OptionalCount,
    angles,
    exclude,
    numbers,
    option_group,
    refuse_existing,
)
from sarsplat.cli.signals import keeping
from sarsplat.errors import counted
from sarsplat.names import ChipFormat, ChipQuantity, ChipScale, Side, Speckle
from sarsplat.settings.config import SCATTERERS


@option_group
class Draws:
    count: OptionalCount = None
    """Chips of each run (default: 360, or as many as there are azimuths)."""
    azimuth: Angles = ()
    """Azimuths of each run's chips in turn: degrees or start:stop:step (stop excluded). Without them, chips are spread
    evenly all around."""
    grazing: Annotated[str | None, tyro.conf.arg(metavar="LO:HI", help_behavior_hint="(optional)")] = None
    """Lowest and highest grazing angle, degrees, between which each chip's is drawn, e.g. 14.5:17.5 (default: those of
    each run's training images)."""
    seed: int = 0
    """Random seed; each chip depends on it and on the chip's number alone."""
    ground: Annotated[str, tyro.conf.arg(metavar="{learned,uniform}|FILE")] = "learned"
    """Ground: that of the training images, with the peculiarities of their site; uniform, of the same mean brightness;
    or a picture of ground, near range at the top, of which parts are drawn."""
    speckle: Speckle = "response"
    """Complex noise through the radar's response; white, without correlation; or none."""
    scatterers: Annotated[float, tyro.conf.arg(metavar="N")] = SCATTERERS
    """Scatterers of the target in a pixel at a time: the fewer, the more its power is in single points; inf: speckle
    alone."""
    shard: OptionalCount = None
    """Write WebDataset shards instead: tar files of this number of chips."""

    def grazing_deg(self) -> tuple[float, float] | None:
        """Return both ends of --grazing, degrees; one angle is both."""
        if self.grazing is None:
            return None
        ends = numbers(self.grazing, "grazing", (1, 2), "14.5:17.5", ":")
        return ends[0], ends[-1]


@option_group
class Pixels:
    quantity: ChipQuantity = "magnitude"
    """Quantity of pixels: √β⁰, β⁰, or complex amplitudes."""
    scale: ChipScale = "max"
    """Level of white: each chip's own maximum; the brightest pixel of all training images; or nothing (calibrated): β⁰
    as the runs have it."""
    format: ChipFormat = "jpeg"
    """Files: jpeg and png of 8 bits; npy of float32, or complex64."""
    jpeg_quality: Annotated[int, tyro.conf.arg(metavar="Q")] = 75
    """Quality of JPEGs, 1 to 100: as that of the measured chips they are mixed with."""
    crop: OptionalCount = None
    """Side of the square that is cut out of the middle of each image, pixels (default: all of it)."""
    near: Side = "bottom"
    """Side of the chips that is near the radar; MSTAR's is the bottom."""


def chips(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN …")],
    *,
    out: Folder,
    measured: bool = False,
    overwrite: bool = False,
    draws: Group[Draws],
    pixels: Group[Pixels],
) -> None:
    """Generate chips to train a classifier on: speckled samples of runs from all around.

    Parameters
    ----------
    runs
        Folders written by `sarsplat reconstruct`, from speckled images on one grid. The class of a run is the target
        of its dataset, or else the name of the run's folder.
    out
        Folder to write: a folder of each class, and labels.csv, with which `import mstar` and `import folder` read the
        chips back. Stopped, the same command goes on from what is there.
    measured
        Instead of generating, write the measured chips of datasets (or of a folder of datasets), given in place of
        runs, the same way: in OUT a folder of each set, in these one of each class.
    overwrite
        Replace an existing folder of chips, or an unfinished one that other options began.
    draws
        Views and speckle of generated chips.
    pixels
        Encoding of chips.
    """
    from sarsplat.samples import chips as chips_of
    from sarsplat.samples import write_chips
    from sarsplat.samples.encoding import LABELS
    from sarsplat.samples.write import MARKER

    encoding = asdict(pixels)
    if measured:
        usual = asdict(Draws())
        exclude("measured", "draws no chips", {name: value != usual[name] for name, value in asdict(draws).items()})
        _write_measured(runs, out, encoding, overwrite)
        return
    refuse_existing(out, overwrite, marker=MARKER)
    made = chips_of(
        runs,
        count=draws.count,
        azimuths_deg=angles(draws.azimuth, "azimuth"),
        grazing_deg=draws.grazing_deg(),
        seed=draws.seed,
        ground=draws.ground,
        speckle=draws.speckle,
        scatterers=draws.scatterers,
        **encoding,
    )
    with keeping(lambda: "what is finished is kept, and the same command goes on from there"):
        write_chips(made, out, shard=draws.shard, overwrite=overwrite, quiet=False)
    many = f" of {len(made.classes)} classes" if len(made.classes) > 1 else f" of {made.classes[0]}"
    rows, columns = made.encoding.size(made.runs[0].grid)
    then = f"look at {shlex.quote(str(out / made.classes[0]))}, and train on all"
    if draws.shard is not None:
        then = f"train on {out}/chips-*.tar, shuffled and"
    console.finish(
        f"{out}: {counted(len(made), 'chip')}{many}, {rows} × {columns} pixels; {LABELS} lists their contents",
        f"{then} mixed with measured chips (docs/how-to/chips.md)",
    )


def _write_measured(datasets: tuple[Path, ...], out: Path, encoding: dict[str, Any], overwrite: bool) -> None:
    """Write measured chips, and print how to train on them."""
    from sarsplat.samples.encoding import LABELS, Encoding
    from sarsplat.samples.measured import MARKER, in_words, write_measured_chips

    refuse_existing(out, overwrite, marker=MARKER)
    written = write_measured_chips(datasets, out, Encoding(**encoding), overwrite=overwrite, quiet=False)
    console.finish(
        f"{out}: {in_words(written)}; {LABELS} lists their contents",
        f"train on {shlex.quote(str(out / 'train'))} (torchvision's ImageFolder), half and half with generated chips "
        "(docs/how-to/chips.md)",
    )
