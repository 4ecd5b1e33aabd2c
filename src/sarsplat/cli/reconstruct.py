"""`sarsplat reconstruct`: a dataset in, a run out; every setting is a flag."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import DEFAULT_PORT, MARKERS, Folder, OptionalFile, OptionalFolder, refuse_existing
from sarsplat.cli.baseline import MethodName, asked_method, reconstruct_by, settings_in
from sarsplat.cli.watch import watched
from sarsplat.errors import SarsplatError
from sarsplat.reconstruction.config import OURS, Config, Densification, Surroundings

if TYPE_CHECKING:
    from sarsplat.data import Dataset

PresetName = Literal["auto", "default", "quick", "speckled", "paper", "measured"]
_PARTS = {"densification": Densification, "surroundings": Surroundings}
"""Parts of the settings that may be absent."""


def _switch(part: str) -> object:
    return tyro.conf.arg(name=part, metavar="{on,off}", help_behavior_hint="(default: as the preset)")


@dataclass(frozen=True)
class Settings(Config):
    """Settings as flags: parts that may be absent are always here, so that their flags are."""

    preset: Annotated[str, tyro.conf.Fixed, tyro.conf.Suppress] = "default"
    densification: Densification = field(default_factory=Densification)
    surroundings: Surroundings = field(default_factory=Surroundings)


@dataclass(frozen=True)
class Options:
    """Options of `sarsplat reconstruct`.

    Parameters
    ----------
    dataset
        Folder written by `sarsplat simulate` or `sarsplat import`.
    out
        Run folder to write; it appears with the first checkpoint. Ctrl-C keeps the progress so far.
    preset
        Starting settings, which the options below override: default (the best in our measurements; its values are
        shown), quick (a first look), speckled (speckle, but no ground), measured (ground, noise floor, speckle), paper
        (the paper's training), or auto: measured if the images show ground, speckled if they have only speckle,
        otherwise default.
    config
        Starting settings from a file written by --print-config, instead of a preset.
    print_config
        Print the settings as JSON and exit.
    method
        What learns: sar-gs, our Gaussians, or to compare with it sar-nerf, sar-nerf-grid or dsr (docs/baselines.md);
        --resume goes on with the run's. Only --iterations, --views-per-step, --checkpoint-every and --seed are options
        of these; their other settings are in the file that --print-config writes.
    masks
        Folder of masks of the training images, from which dsr learns; `sarsplat simulate --masks` writes them.
    device
        Where to train; auto uses a GPU if a usable one is present.
    view
        Show the training in the browser while it goes on; its result is the same.
    port
        Port of 127.0.0.1 for --view; 0 takes any that is free.
    resume
        Continue the run in --out with the settings it was started with; DATASET may have moved. A larger --iterations
        extends the run; other --points.* extract its points anew.
    tensorboard
        Also write a log for TensorBoard to the run's folder `tensorboard`: curves, and images of a few fixed views.
    overwrite
        Replace an existing run, which is kept until the new one has its first checkpoint.
    densify
        Density control; any of its options below switches it on.
    surround
        Model of ground and noise; any of its options below switches it on.
    settings
        Settings.
    """

    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    out: Folder
    preset: PresetName = "auto"
    config: OptionalFile = None
    print_config: bool = False
    method: Annotated[MethodName | None, tyro.conf.arg(help_behavior_hint="(default: sar-gs)")] = None
    masks: OptionalFolder = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    view: bool = False
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = DEFAULT_PORT
    resume: bool = False
    tensorboard: bool = False
    overwrite: bool = False
    densify: Annotated[Literal["on", "off"] | None, _switch("densification")] = None
    surround: Annotated[Literal["on", "off"] | None, _switch("surroundings")] = None
    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()


def reconstruct(
    options: Annotated[Options, tyro.conf.arg(name="")],
    words: Annotated[tuple[str, ...], tyro.conf.Fixed, tyro.conf.Suppress] = (),
) -> None:
    """Reconstruct Gaussians and points from the training images of a dataset."""
    dataset, out = options.dataset, options.out
    if options.resume and options.overwrite:
        raise SarsplatError("--resume continues the run and --overwrite discards it; give only one of them")
    if (method := asked_method(options.method, options.resume, out)) != OURS:
        reconstruct_by(method, options, words)
        return
    from sarsplat.data import read_dataset
    from sarsplat.reconstruction import reconstruct as train
    from sarsplat.reconstruction.any_run import HEADER

    if options.masks is not None:
        raise SarsplatError(
            f"--masks {options.masks} is for methods that learn from masks; {OURS} does not, so omit it"
        )
    images = read_dataset(dataset)
    config = _overridden(_base(options, images), options, words)
    if options.print_config:
        json.dump(config.as_dict(), sys.stdout, indent=2)
        sys.stdout.write("\n")
        return
    if not options.resume:
        refuse_existing(out, options.overwrite, marker=HEADER)
    with watched(options, images) as on_step:
        run = train(
            images,
            config,
            out,
            device=options.device,
            on_step=on_step,
            resume=options.resume,
            overwrite=options.overwrite,
        )
    console.finish(
        f"{out}: {len(run.gaussians)} Gaussians and {len(run.points)} points in {run.time_s:.0f} s "
        f"(preset {config.preset}, seed {run.seed})",
        f"sarsplat evaluate {shlex.quote(str(out))}",
    )


def _base(options: Options, images: Dataset) -> Config:
    """What the flags of settings override."""
    from sarsplat.reconstruction import Run
    from sarsplat.reconstruction.training import fitting

    if options.config is not None:
        if options.preset != "auto":
            raise SarsplatError(
                f"--config and --preset {options.preset} both choose the starting settings; give only one of them"
            )
        return Config.from_dict(settings_in(options.config, OURS), str(options.config))
    if not options.resume:
        return fitting(options.preset, images)
    begun = Run.load(options.out).config
    if options.preset not in ("auto", begun.preset):
        raise SarsplatError(
            f"{options.out} was started with preset {begun.preset!r}, not {options.preset!r}; omit --preset"
        )
    return begun


def _overridden(base: Config, options: Options, words: Sequence[str]) -> Config:
    """The words read once more, on the settings that they override."""
    values = {field.name: getattr(base, field.name) for field in fields(Config)}
    present = {part: values[part] or record() for part, record in _PARTS.items()}
    defaults = Options(options.dataset, options.out, settings=Settings(**{**values, **present}))
    settings = tyro.cli(Options, args=words, default=defaults, config=MARKERS).settings
    changed = {name: getattr(settings, name) for name in values}
    for part, switch in (("densification", options.densify), ("surroundings", options.surround)):
        flag = next((word for word in words if word.startswith(f"--{part}.")), None)
        if switch == "off" and flag is not None:
            raise SarsplatError(f"{flag} has no effect with --{part} off; omit one of them")
        if switch == "off" or (switch is None and flag is None and values[part] is None):
            changed[part] = None
    return Config(**changed)
