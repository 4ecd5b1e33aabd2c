"""`sarsplat reconstruct`: reconstruct a dataset into a run; every setting is an option."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, field, fields, make_dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import (
    DEFAULT_PORT,
    Folder,
    Group,
    OptionalFile,
    OptionalFolder,
    TargetBox,
    Workers,
    exclude,
    one_of,
    option_group,
    refuse_existing,
)
from sarsplat.cli.commands import unwrapped
from sarsplat.cli.signals import Stopped, keeping
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
    from sarsplat.runs import Step

    ExecutorName = str
    MethodName = str
    PresetName = str
else:
    ExecutorName = tyro.extras.literal_type_from_choices(EXECUTORS)
    MethodName = tyro.extras.literal_type_from_choices(METHODS)
    PresetName = tyro.extras.literal_type_from_choices(("auto", *PRESETS))

_LOG_FOLDER = "tensorboard"  # in the run's folder

_PARTS = {one.name: kind for one in fields(Config) if one.default is None and (kind := record_in(Config, one.name))}
"""Records of settings that may be absent, by field name: each is switched on or off as one."""

# Settings as options, with all records that may be absent.
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


@option_group
class Options:
    """Options of `sarsplat reconstruct`."""

    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder written by `sarsplat simulate` or `sarsplat import`."""
    out: Folder
    """Run folder to write; it appears with the first checkpoint. Ctrl-C keeps the progress so far."""
    preset: PresetName = "auto"
    """Starting settings, which the options below override: default (the best in our measurements; its values are
    shown), quick (a first look), speckled (speckle, but no ground), scene (speckle on ground, any number of objects),
    measured (chips with shift and gain), stack (interferometric passes), polarimetric (several polarisations), paper
    (the paper's training), or auto: by the dataset's stacks, speckle and ground, and by a short trial. Of the others,
    all but paper model ground that is shown."""
    config: OptionalFile = None
    """Starting settings from a file written by --print-config, instead of a preset."""
    print_config: bool = False
    """Print the settings as JSON and exit."""
    method: Annotated[MethodName | None, tyro.conf.arg(help_behavior_hint="(default: sar-gs)")] = None
    """Method: sar-gs, our Gaussians, or for comparison sar-nerf, sar-nerf-grid or dsr (docs/concepts/baselines.md);
    --resume continues with the run's. Only --iterations, --views-per-step, --checkpoint-every and --seed are options of
    these; their other settings are in the file that --print-config writes."""
    masks: OptionalFolder = None
    """Folder of masks of the training images, from which dsr learns; `sarsplat simulate --masks` writes them."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device; auto uses a GPU if a usable one is present and not slower."""
    executor: Annotated[ExecutorName | None, one_of(ExecutorName)] = None
    """Executor of --tiles: local, processes of this machine with one thread each, or ray, a Ray cluster (default: this
    process, one tile after the other). The result is the same."""
    workers: Group[Workers] = Workers()
    view: bool = False
    """Show the training in the browser while it goes on; its result is the same."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = DEFAULT_PORT
    """Port of 127.0.0.1 for --view; 0 takes any that is free."""
    resume: bool = False
    """Continue the run in --out with the settings it was started with; DATASET may have moved. A larger --iterations
    extends the run; other --points.* extract its points anew."""
    tensorboard: bool = False
    """Also write a log for TensorBoard to the run's folder `tensorboard`: curves, and images of a few fixed views."""
    overwrite: bool = False
    """Replace an existing run, which is kept until the new one has its first checkpoint."""
    switches: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=Switches)
    """Parts of the model and of its training."""
    settings: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=Settings)


for one in (Config, *(record for one in fields(Config) if (record := record_in(Config, one.name)))):
    one.__doc__ = unwrapped(one.__doc__)


def reconstruct(
    options: Annotated[Options, tyro.conf.arg(name="")],
    words: Annotated[tuple[str, ...], tyro.conf.Fixed, tyro.conf.Suppress] = (),
) -> None:
    """Reconstruct Gaussians and points from the training images of a dataset."""
    dataset, out = options.dataset, options.out
    exclude("resume", "continues the run", {"overwrite": options.resume and options.overwrite})
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
        "means": Means(**asdict(options.workers)),
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
        f"sarsplat evaluate {typed}",
    )


def _announce(dataset: Path) -> None:
    """Print a summary of the dataset at once: importing torch takes seconds."""
    from sarsplat.data.dataset_folder import read_header

    header = read_header(dataset)
    train = sum(view.split == "train" for view in header.views)
    console.say(
        f"reading {dataset}: {counted(len(header.views), 'image')} of {header.target}, {train:,} of them to train on, "
        f"{header.grid.rows} × {header.grid.columns} pixels"
    )


def _warn_of_contradictions(dataset: Path, images: Dataset) -> None:
    """Warn of contradictions that the import found; a new examination would take too long."""
    found = images.source.get("contradictions")
    if isinstance(found, list) and found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        look = shlex.join(["sarsplat", "check", str(dataset)])
        console.warn(
            f"{dataset} contradicts itself, so the result may be wrong: "
            f"{str(found[0]).partition(';')[0]}{more}; `{look}` explains it"
        )


def _base(method: Method, options: Options, images: Dataset) -> Any:
    """Return the settings of a file, of the run to resume, or of the preset, which options override."""
    from sarsplat.data import read_json
    from sarsplat.runs import Run

    file, out = options.config, options.out
    if file is not None:
        exclude("config", "holds all settings", {"preset": options.preset != "auto"})
        content = read_json(file, dict[str, Any])
        if (whose := content.get("method", DEFAULT_METHOD)) != method.name:
            raise SarsplatError(f"{file} holds settings of {shown(whose)}, not of {method.name}; give that as --method")
        if isinstance(of_run := content.get("config"), dict):
            return method.settings.of_run(of_run, str(file))
        return method.settings.from_dict(content.get("config", content), str(file))
    if not options.resume:
        return method.preset(options.preset, images)
    run = Run.load(out)
    preset = getattr(run.config, "preset", "auto")
    for name, begun, asked in (("method", run.method, method.name), ("preset", preset, options.preset)):
        if asked not in (begun, "auto"):
            raise SarsplatError(f"{out} was started with {name} {begun!r}, not {asked!r}; omit --{name}")
    return run.config


def _overridden(method: Method, base: AnyConfig, options: Options, words: Sequence[str]) -> AnyConfig:
    """Return the settings with the values of typed options only."""
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
                f"--{flag} is not a setting of {method.name}; change those that --print-config shows, for --config"
            )
        given = getattr(options.settings, name)
        if inside:
            of_records.setdefault(name, {})[inside] = getattr(given, inside)
        elif name not in _PARTS:
            changed[name] = given
    for name, values in of_records.items():
        if name in _PARTS and getattr(options.switches, name) == "off":
            exclude(f"{name} off", "leaves it out", {console.option_name(f"{name}.{one}"): True for one in values})
        changed[name] = replace(getattr(base, name) or _PARTS[name](), **values)
    for part, record in _PARTS.items():
        switch = getattr(options.switches, part)
        if switch == "off":
            changed[part] = None
        elif switch == "on" and part not in changed:
            changed[part] = getattr(base, part) or record()
    return replace(base, **changed)


@contextmanager
def watched(
    dataset: Path, out: Path, images: Dataset, *, tensorboard: bool, port: int | None
) -> Iterator[Callable[[Step[Any]], object]]:
    """Log a training for TensorBoard, show it in a browser, and let Ctrl-C end it between two steps.

    Before the first step is done and after the last one, Ctrl-C ends it at once. The yielded function is called after
    each step. The KeyboardInterrupt says how to resume if there is a checkpoint.
    """
    words = shlex.join(["sarsplat", "reconstruct", str(dataset), "--out", str(out), "--resume"])
    advice = f"{out} keeps the progress so far; continue with `{words}`"
    with keeping(lambda: advice if (out / "config.json").is_file() else ""), ExitStack() as stack:
        hold_back = stack.enter_context(_interrupts())
        watchers: list[Callable[[Step[Any]], object]] = []
        if tensorboard:
            from sarsplat.runs.tensorboard import TensorBoard

            board = TensorBoard(out / _LOG_FOLDER, images)
            stack.callback(board.close)
            watchers.append(board)
        if port is not None:
            from sarsplat.viewer import watched as shown

            watchers.append(stack.enter_context(shown(images, port, console.say)))

        def on_step(step: Step[Any]) -> None:
            for watcher in watchers:
                watcher(step)
            if number := hold_back(not step.last):
                raise Stopped(number)

        yield on_step


@contextmanager
def _interrupts() -> Iterator[Callable[[bool], int]]:
    """Raise `Stopped` at SIGINT and SIGTERM inside the block, at first at once.

    The yielded function switches to holding signals back, or not, and returns the number of one held back, or 0. A
    second one is not held back. Outside the main thread, which alone receives signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda held: 0
        return
    asked, holding = 0, False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked or not holding:
            raise Stopped(number)
        asked = number
        os.write(2, b"\nstopping after this step; once more stops at once\n")  # print must not be called in here

    def hold_back(held: bool) -> int:
        nonlocal holding
        holding = held
        return asked

    before = {number: signal.signal(number, hold) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield hold_back
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
