"""`sarsplat reconstruct`: reconstruct a dataset into a run; every setting is a flag."""

from __future__ import annotations

import json
import re
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import (
    DEFAULT_PORT,
    Folder,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalNumber,
    TargetBox,
    one_of,
    refuse_existing,
)
from sarsplat.cli.commands import unwrapped
from sarsplat.cli.watch import watched
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.executors import EXECUTORS, Means
from sarsplat.names import SCATTERINGS
from sarsplat.runs.methods import METHODS, method_named
from sarsplat.settings.config import DEFAULT_METHOD, AnyConfig, Config
from sarsplat.settings.presets import PRESETS
from sarsplat.settings.record import Record, record_in

if TYPE_CHECKING:
    from sarsplat.data import Dataset
    from sarsplat.learning.method import Method

    ExecutorName = str
    MethodName = str
    PresetName = str
else:
    ExecutorName = tyro.extras.literal_type_from_choices(EXECUTORS)
    MethodName = tyro.extras.literal_type_from_choices(METHODS)
    PresetName = tyro.extras.literal_type_from_choices(("auto", *PRESETS))

_PARTS = {one.name: kind for one in fields(Config) if one.default is None and (kind := record_in(Config, one.name))}
"""Records of settings that may be absent, by the name of their field: each is switched on or off as a whole."""

# Settings as options: records that may be absent are always here, so that their options are.
Settings = make_dataclass(
    "Settings",
    [
        ("preset", Annotated[str, tyro.conf.Fixed, tyro.conf.Suppress], "default"),
        ("target_box", TargetBox, None),
        ("scattering", tyro.extras.literal_type_from_choices(SCATTERINGS), Config.scattering),
        # a flag's name would depend on its default, which a run or a file may change
        ("common_law", Annotated[bool, tyro.conf.FlagConversionOff], Config.common_law),
        *((name, kind, field(default_factory=kind)) for name, kind in _PARTS.items()),
    ],
    bases=(Config,),
    frozen=True,
)


def _switch(kind: type[Record]) -> object:
    about = re.split(r"[.;](?!\w)", kind.__doc__ or "")[0]
    return tyro.conf.arg(
        metavar="{on,off}",
        help=f"{about}; any of its options below switches it on.",
        help_behavior_hint="(default: as the preset)",
    )


Switches = make_dataclass(
    "Switches",
    [(name, Annotated[Literal["on", "off"] | None, _switch(kind)], None) for name, kind in _PARTS.items()],
    frozen=True,
)


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
        shown), quick (a first look), speckled (speckle, but no ground), scene (speckle on ground, any number of
        objects), measured (chips with shift and gain), stack (interferometric passes), polarimetric (several
        polarisations), paper (the paper's training), or auto: by the dataset's stacks, speckle and ground, and by a
        short trial. Of the others, all but paper model ground that is shown.
    config
        Starting settings from a file written by --print-config, instead of a preset.
    print_config
        Print the settings as JSON and exit.
    method
        What learns: sar-gs, our Gaussians, or to compare with it sar-nerf, sar-nerf-grid or dsr
        (docs/concepts/baselines.md); --resume continues with the run's. Only --iterations, --views-per-step,
        --checkpoint-every and --seed are options of these; their other settings are in the file that --print-config
        writes.
    masks
        Folder of masks of the training images, from which dsr learns; `sarsplat simulate --masks` writes them.
    device
        Where to train; auto uses a GPU if a usable one is present and not slower.
    executor
        Who learns the tiles of --tiles: local, processes of this machine with one thread each, or ray, a Ray cluster
        (default: this process, one tile after the other). The result is the same.
    processes
        Tiles at a time on the CPU with local (default: as many as processors). Each takes the memory of one.
    per_device
        Tiles at a time on each GPU with local (default: 4, or as many as there are processors for it).
    address
        Of the cluster with ray; auto is the one that runs here.
    gpus
        GPUs of a tile with ray: 0.25 lets four tiles share one (default: 1 if it is trained on one).
    retries
        How often ray starts a tile again whose node has died.
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
    switches
        Parts of the model and of its training.
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
    executor: Annotated[ExecutorName | None, one_of(ExecutorName)] = None
    processes: OptionalCount = None
    per_device: OptionalCount = None
    address: str = "auto"
    gpus: OptionalNumber = None
    retries: int = 3
    view: bool = False
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = DEFAULT_PORT
    resume: bool = False
    tensorboard: bool = False
    overwrite: bool = False
    switches: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=Switches)
    settings: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=Settings)


for one in (Options, Config, *(record for one in fields(Config) if (record := record_in(Config, one.name)))):
    one.__doc__ = unwrapped(one.__doc__)


def reconstruct(
    options: Annotated[Options, tyro.conf.arg(name="")],
    words: Annotated[tuple[str, ...], tyro.conf.Fixed, tyro.conf.Suppress] = (),
) -> None:
    """Reconstruct Gaussians and points from the training images of a dataset."""
    dataset, out = options.dataset, options.out
    if options.resume and options.overwrite:
        raise SarsplatError("--resume continues the run and --overwrite discards it; give only one of them")
    if not options.print_config:
        _announce(dataset)
    from sarsplat.data import read_dataset
    from sarsplat.examination.plausible import weakest_direction
    from sarsplat.runs import reconstruct as train
    from sarsplat.runs.run_folder import HEADER, read_header

    begun = read_header(out).method if options.resume and options.method is None else DEFAULT_METHOD
    method = method_named(options.method or begun)
    if options.view and not method.watchable:
        raise SarsplatError(f"--view cannot show a training by {method.name}; omit it, and view the run")
    images = read_dataset(dataset)
    config = _overridden(method, _base(method, options, images), options, words)
    if options.print_config:
        json.dump({"method": method.name, "config": config.as_dict()}, sys.stdout, indent=2)
        sys.stdout.write("\n")
        return
    if not options.resume:
        refuse_existing(out, options.overwrite, marker=HEADER)
        _warn_of_contradictions(dataset, images)
    choices: dict[str, Any] = {
        "method": method.name,
        "masks": options.masks,
        "device": options.device,
        "executor": options.executor,
        "means": Means(
            options.processes, options.address, options.gpus, options.retries, per_device=options.per_device
        ),
        "resume": options.resume,
        "overwrite": options.overwrite,
    }
    port, begun_at = options.port if options.view else None, time.monotonic()
    with watched(options.dataset, options.out, images, tensorboard=options.tensorboard, port=port) as on_step:
        run = train(images, config, out, on_step=on_step, **choices)
    typed, again = shlex.quote(str(out)), shlex.join(["sarsplat", "reconstruct", str(dataset), "--out", str(out)])
    if len(run.points) == 0:
        longer = f"{again} --resume --iterations {max(2 * config.iterations, Config.iterations)}"
        elsewhere = " or, if its loss hardly falls, look elsewhere with --target-box"
        console.warn(f"there are no points of a surface yet; train longer, such as with `{longer}`,{elsewhere}")
    elif not images.passes and (weakest := weakest_direction(images.select("train").views)).uncertain:
        verdict = "not determined" if weakest.undetermined else "uncertain"
        console.warn(f"the shape in {out} is {verdict}: the weakest direction of its views is {weakest}")
    console.finish(
        f"{out}: {run.learned} and {counted(len(run.points), 'point')} in {time.monotonic() - begun_at:.0f} s "
        f"({run.time_s:.0f} s of training; {method.about(config, images.grid)[0]}, seed {run.seed})",
        _next(images, typed, learns_speckle=getattr(config, "passes", None) is None),
    )


def _announce(dataset: Path) -> None:
    """Say what is going to be read, at once: importing torch takes seconds."""
    from sarsplat.data.dataset_folder import read_header

    header = read_header(dataset)
    train = sum(view.split == "train" for view in header.views)
    console.say(
        f"reading {dataset}: {counted(len(header.views), 'image')} of {header.target}, {train:,} of them to train on, "
        f"{header.grid.rows} × {header.grid.columns} pixels"
    )


def _next(images: Dataset, run: str, learns_speckle: bool) -> str:
    """The next command to type: `evaluate` if there is anything to score."""
    if len(images.splits()) > 1 or images.truth_mesh is not None:
        return f"sarsplat evaluate {run}"
    if images.looks is None or not learns_speckle:
        return f"sarsplat view {run}"
    return f"sarsplat view {run}, or sarsplat chips {run} --out DIR"


def _warn_of_contradictions(dataset: Path, images: Dataset) -> None:
    """Say that the import has found the dataset to contradict itself; to look again would take too long."""
    found = images.source.get("contradictions")
    if isinstance(found, list) and found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        look = shlex.join(["sarsplat", "check", str(dataset)])
        console.warn(
            f"{dataset} contradicts itself, so what is learned from it may be wrong: "
            f"{str(found[0]).partition(';')[0]}{more}; `{look}` says how to mend it"
        )


def _base(method: Method, options: Options, images: Dataset) -> Any:
    """The settings that flags override: those of a file, of the run to resume, or of the preset."""
    from sarsplat.data import read_json
    from sarsplat.runs import Run

    file, out = options.config, options.out
    if file is not None:
        if options.preset != "auto":
            raise SarsplatError(
                f"--config and --preset {options.preset} both choose the starting settings; give only one of them"
            )
        content = read_json(file, dict[str, Any])
        if (whose := content.get("method", DEFAULT_METHOD)) != method.name:
            raise SarsplatError(f"{file} holds settings of {shown(whose)}, not of {method.name}; give that as --method")
        if isinstance(of_run := content.get("config"), dict):
            return method.settings.of_run(of_run, str(file))
        return method.settings.from_dict(content.get("config", content), str(file))
    if not options.resume:
        return method.preset(options.preset, images)
    run = Run.load(out)
    if run.method != method.name:
        raise SarsplatError(f"{out} was started with the method {run.method}, not {method.name}; omit --method")
    begun = getattr(run.config, "preset", "auto")
    if options.preset not in ("auto", begun):
        raise SarsplatError(f"{out} was started with preset {begun!r}, not {options.preset!r}; omit --preset")
    return run.config


def _overridden(method: Method, base: AnyConfig, options: Options, words: Sequence[str]) -> AnyConfig:
    """The settings with what the flags say, and nothing of those that were not typed."""
    flags = [word[2:].partition("=")[0] for word in words if word.startswith("--")]
    known = {one.name for one in fields(Config)} - {"preset"}  # which has made the base
    changed: dict[str, Any] = {}
    of_records: dict[str, dict[str, Any]] = {}
    for flag in flags:
        name, _, inside = flag.replace("-", "_").partition(".")
        if name not in known:  # another option
            continue
        if not hasattr(base, name):
            raise SarsplatError(
                f"--{flag} is not a setting of {method.name}; see its settings with --print-config, and give changed "
                "ones with --config FILE"
            )
        given = getattr(options.settings, name)
        if inside:
            of_records.setdefault(name, {})[inside] = getattr(given, inside)
        elif name not in _PARTS:
            changed[name] = given
    for name, values in of_records.items():
        if name in _PARTS and getattr(options.switches, name) == "off":
            raise SarsplatError(
                f"--{name}.{next(iter(values)).replace('_', '-')} has no effect with --{name} off; omit one of them"
            )
        changed[name] = replace(getattr(base, name) or _PARTS[name](), **values)
    for part, record in _PARTS.items():
        switch = getattr(options.switches, part)
        if switch == "off":
            changed[part] = None
        elif switch == "on" and part not in changed:
            changed[part] = getattr(base, part) or record()
    return replace(base, **changed)
