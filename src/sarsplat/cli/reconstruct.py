"""`sarsplat reconstruct`: a dataset in, a run out."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Folder, OptionalCount, OptionalName, refuse_existing
from sarsplat.cli.interrupt import interrupts_held_back
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    from sarsplat.reconstruction import Step

Initialisation = Annotated[
    Literal["box", "hemisphere"] | None,
    tyro.conf.arg(metavar="{box,hemisphere}", help_behavior_hint="(optional)"),
]


def reconstruct(
    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")],
    *,
    out: Folder,
    preset: OptionalName = None,
    init: Initialisation = None,
    seed: OptionalCount = None,
    iterations: OptionalCount = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Reconstruct Gaussians and points from the training images of a dataset.

    Parameters
    ----------
    dataset
        Folder that `sarsplat simulate` or `sarsplat import` made.
    out
        Run to make; it appears with its first checkpoint. What has been learned so far is kept there on Ctrl-C.
    preset
        default (measures best), paper (the paper's training) or measured (ground, noise floor, speckle); measured
        if the images show ground and default otherwise, unless given.
    init
        Start in the box the images bound, or on the paper's hemisphere, instead of the preset's choice.
    seed
        Seed of everything random; 0 unless given.
    iterations
        Number of training steps instead of the preset's.
    device
        Where to train; auto is a GPU if there is one that can be used.
    resume
        Go on with the run in --out, with the settings it was begun with; DATASET may have been moved.
    overwrite
        Replace an existing run, which is kept until the new one has its first checkpoint.
    """
    from sarsplat.data import read_dataset
    from sarsplat.reconstruction import Run
    from sarsplat.reconstruction import reconstruct as train
    from sarsplat.reconstruction.run import HEADER
    from sarsplat.reconstruction.training import fitting

    if resume and overwrite:
        raise SarsplatError("--resume goes on with the run and --overwrite throws it away; give one of them")
    images = read_dataset(dataset)
    if resume:
        config = Run.load(out).config
        if preset is not None and preset != config.preset:
            raise SarsplatError(f"{out} was begun with preset {config.preset!r}, not {preset!r}; leave --preset out")
    else:
        config = fitting(preset or "auto", images)
        refuse_existing(out, overwrite, marker=HEADER)
    chosen: dict[str, Any] = {"initialisation": init, "seed": seed, "iterations": iterations}
    if iterations is not None and iterations < 1:
        raise SarsplatError(f"--iterations {iterations} must be at least 1")
    config = dataclasses.replace(config, **{name: value for name, value in chosen.items() if value is not None})
    place = shlex.quote(str(out))

    def stop_if_asked(step: Step) -> None:
        if interrupted():
            raise KeyboardInterrupt

    try:
        with interrupts_held_back() as interrupted:
            run = train(images, config, out, device=device, on_step=stop_if_asked, resume=resume, overwrite=overwrite)
    except KeyboardInterrupt as interrupt:
        if interrupt.args or not (out / "config.json").is_file():
            raise
        raise KeyboardInterrupt(
            f"stopped by Ctrl-C; {out} holds what was learned so far: go on with "
            f"`sarsplat reconstruct {shlex.quote(str(dataset))} --out {place} --resume`"
        ) from None
    console.finish(
        f"{out}: {len(run.gaussians)} Gaussians and {len(run.points)} points in {run.time_s:.0f} s "
        f"(preset {config.preset}, seed {run.seed})",
        f"sarsplat evaluate {place}",
    )
