"""Types of options that several commands share, and their parsers: angles, lengths, boxes, runs."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, dataclass_transform, get_args, get_type_hints

import tyro

from sarsplat.cli import console
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float64

    from sarsplat.data.header import Box
    from sarsplat.gaussians import Gaussians
    from sarsplat.geometry import Terrain, View
    from sarsplat.runs import Run

MARKERS = (tyro.conf.FlagCreatePairsOff,)
"""Markers for tyro of all commands."""

T = TypeVar("T")
Group = Annotated[T, tyro.conf.OmitArgPrefixes]
"""An `option_group` as a field of another, shown below its name in help."""

RunFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
RunOrFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|PLY")]
"""A run's folder, or a PLY or .splat file of Gaussians; see `run_at`."""

COMPRESSED = (".spz", ".sog", ".ksplat")  # endings of files of Gaussians that have to be converted

Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="(optional)")]
OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")]
OptionalName = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(optional)")]
OptionalNumber = Annotated[float | None, tyro.conf.arg(metavar="NUMBER", help_behavior_hint="(optional)")]
OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(optional)")]
Metres = Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="(optional)")]
Lengths = Annotated[tuple[float, ...], tyro.conf.arg(metavar="METRES [METRES]", help_behavior_hint="(optional)")]
"""Lengths in azimuth and range, or one for both; see `pair`."""

TargetBox = Annotated[
    tuple[float, float, float, float, float, float] | None,
    tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="(optional)"),
]
"""Lower and upper corner; see `corners`."""

Angles = Annotated[tuple[str, ...], tyro.conf.arg(metavar="DEG …", help_behavior_hint="")]
"""Numbers or ranges start:stop:step, degrees, with spaces or commas between them; see `angles`."""

DEFAULT_PORT = 8765
"""Default port of the pages of `view` and `reconstruct --view`."""

_MAX_ANGLES = 10_000


@dataclass_transform(frozen_default=True)
def option_group(record: type[T]) -> type[T]:
    """Make a frozen dataclass whose fields are options, with the docstrings below them as help.

    tyro would find these by itself, but takes 10 ms a class.
    """
    source = Path(sys.modules[record.__module__].__file__ or "").read_text("utf-8")
    source = source.partition(f"class {record.__name__}:\n")[2]
    helps = dict(_DOCUMENTED.findall(source.partition("\n\n\n")[0]))
    for name, kind in get_type_hints(record, include_extras=True).items():
        record.__annotations__[name] = Annotated[kind, tyro.conf.arg(help=" ".join(helps.get(name, "").split()))]
    return dataclass(frozen=True)(record)


_DOCUMENTED = re.compile(r'^    (\w+): .*\n(?:        .*\n|    \].*\n)*    """([^"]*)"""', re.MULTILINE)
"""A field of a class and the docstring below it."""


@option_group
class Workers:
    """Processes or cluster for runs of a sweep, or tiles of a reconstruction; here both are jobs."""

    processes: OptionalCount = None
    """Jobs at a time on the CPU with local (default: as many as processors). Each takes the memory of one
    reconstruction, or tile."""
    per_device: OptionalCount = None
    """Jobs at a time on each GPU with local (default: 4, or as many as there are processors for it)."""
    address: str = "auto"
    """Address of the Ray cluster; auto is the one on this machine."""
    gpus: OptionalNumber = None
    """GPUs of a job with ray: 0.25 lets four share one (default: 1 if it is trained on one)."""
    retries: int = 3
    """Maximum number of restarts with ray of a job whose node has died."""


def one_of(literal: Any, hint: str = "(optional)") -> Any:
    """Return the help of an optional name of a `Literal`; tyro would list None as well."""
    return tyro.conf.arg(metavar=f"{{{','.join(get_args(literal))}}}", help_behavior_hint=hint)


def angles(texts: Sequence[str], name: str) -> list[float]:
    """Return degrees from words such as `30`, `-7.5` and `0:360:15` (start:stop:step; the stop is excluded)."""
    values: list[float] = []
    for text in ",".join(texts).split(",") if texts else ():
        try:
            numbers = [float(part) for part in text.split(":")]
        except ValueError:
            numbers = []
        if len(numbers) == 1:
            values += numbers
            continue
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or numbers[2] == 0:
            raise SarsplatError(f"--{name} {text!r} is neither degrees, such as 30, nor a range, such as 0:360:15")
        start, stop, step = numbers
        steps = (stop - start) / step - 1e-9
        if not 0 < steps <= _MAX_ANGLES:  # also catches overflow
            raise SarsplatError(
                f"--{name} {text!r} is {max(steps, 0):.0f} angles; give 1 to {_MAX_ANGLES} in steps from {start:g}° "
                f"towards {stop:g}°"
            )
        values += [start + step * k for k in range(math.ceil(steps))]
    return values


def corners(box: tuple[float, float, float, float, float, float] | None) -> Box | None:
    """Return the corners of --target-box, m; raise if it is empty."""
    if box is None:
        return None
    if not all(-math.inf < low < high < math.inf for low, high in zip(box[:3], box[3:], strict=True)):
        given = " ".join(f"{value:g}" for value in box)
        raise SarsplatError(f"--target-box {given} is no box; give the lower corner (x, y, z), then the upper one, m")
    return box[:3], box[3:]


def heights(path: Path | None) -> Terrain | None:
    """Return the terrain of --terrain, with heights relative to that of the scene's origin."""
    from sarsplat.data import read_terrain

    return None if path is None else read_terrain(path).centred()


def pair(lengths: tuple[float, ...], name: str) -> tuple[float, float] | None:
    """Return (azimuth, range) from one or two lengths; None if no length is given."""
    require_count(name, lengths, (0, 1, 2), "one, or two: azimuth and range")
    return (lengths[0], lengths[-1]) if lengths else None


def numbers(text: str, name: str, counts: tuple[int, ...], example: str, between: str = ",") -> tuple[float, ...]:
    """Return the numbers in a text; raise unless their number is one of `counts`."""
    try:
        values = tuple(map(float, text.split(between)))
    except ValueError:
        values = ()
    if len(values) not in counts:
        wanted = "a number" if counts == (1,) else f"{' or '.join(map(str, counts))} numbers"
        raise SarsplatError(f"--{name} {text!r} is not {wanted}; write it as {example}")
    return values


def require_count(name: str, values: Sequence[float], counts: Container[int], wanted: str) -> None:
    """Raise unless an option has one of these counts of numbers; `wanted` says which."""
    if len(values) not in counts:
        raise SarsplatError(f"--{name} has {len(values)} numbers; give {wanted}")


def exclude(name: str, does: str, others: Mapping[str, object]) -> None:
    """Raise if an option, which `does` something, was given with one of `others`: option → whether it was given."""
    if (other := _first_given(others)) is not None:
        raise SarsplatError(f"--{name} {does}, but --{other} was given; leave out one of them")


def require(needed: str, others: Mapping[str, object]) -> None:
    """Raise if one of `others`, option → whether it was given, lacks the option `needed`."""
    if (other := _first_given(others)) is not None:
        raise SarsplatError(f"--{other} needs {needed}; give that too, or leave out --{other}")


def _first_given(options: Mapping[str, object]) -> str | None:
    return next((name for name, given in options.items() if given), None)


def require_ending(name: str, path: Path, *endings: str) -> None:
    """Raise unless the name of an output ends in one of these."""
    if path.suffix.lower() not in endings:
        raise SarsplatError(f"--{name} {path} does not end in {' or '.join(endings)}; choose a name that does")


def grazings(grazing: Sequence[str], incidence: Sequence[str], prefix: str = "") -> list[float]:
    """Return grazing angles, degrees, from these or incidence angles; [] without both."""
    exclude(f"{prefix}grazing", "is 90° less incidence", {f"{prefix}incidence": grazing and incidence})
    return [*(90.0 - angle for angle in angles(incidence, f"{prefix}incidence")), *angles(grazing, f"{prefix}grazing")]


def views_from(
    azimuth: Sequence[str],
    grazing: Sequence[str],
    incidence: Sequence[str],
    prefix: str = "",
    like: Sequence[View] = (),
) -> list[View]:
    """Return every azimuth at every grazing (or incidence) angle once; `prefix` names the options in errors.

    Tilt and side are those of the views `like` (`seen_alike`).
    """
    from sarsplat.examination.plausible import suspicious_angles, warn
    from sarsplat.geometry import View
    from sarsplat.geometry.view import seen_alike

    azimuths, elevations = angles(azimuth, f"{prefix}azimuth"), grazings(grazing, incidence, prefix)
    for given, missing in ((elevations, "grazing"), (azimuths, "azimuth")):
        if not given:
            raise SarsplatError(f"--{prefix}{missing} is missing; give degrees or a range, such as 10:70:15")
    like = like or (View(0.0, 45.0),)
    views = list(dict.fromkeys(seen_alike(like, a, e) for e in elevations for a in azimuths))
    warn(suspicious_angles(views))
    return views


def is_gaussians(path: Path) -> bool:
    """Return whether a path is a file of Gaussians, not a run."""
    return not path.is_dir() and path.suffix.lower() in (".ply", ".splat", ".glb", *COMPRESSED)


def run_at(path: Path, *, strays: bool = True) -> Run:
    """Return the run in a folder, or a run in memory of the Gaussians in a file, with or without outliers.

    FILE.place.json is the georeference of a file.
    """
    from sarsplat.exports.georeference import read_place
    from sarsplat.runs import Run

    if not is_gaussians(path):
        return trained_so_far(path)
    place = read_place(path)
    with console.busy(f"reading {path}"):
        gaussians, moved = gaussians_around_origin(path, strays=strays)
        return replace(Run.from_gaussians(gaussians), place=place and place.moved(moved))


def gaussians_around_origin(path: Path, *, strays: bool) -> tuple[Gaussians, Float64[np.ndarray, " 3"]]:
    """Return the Gaussians in a file and the vector subtracted from their means, m; print it and removed outliers."""
    from sarsplat.data.ply import read_centred_gaussians
    from sarsplat.runs.own_gaussians import without_strays

    gaussians, moved = read_centred_gaussians(path)
    if moved.any():
        middle = ", ".join(f"{value:.10g}" for value in moved)
        console.say(f"the Gaussians lie around ({middle}) m; that was subtracted, for images are centred on the origin")
    if not strays:
        gaussians, left_out = without_strays(gaussians)
        if left_out:
            console.warn(f"{left_out}; they are left out")
    return gaussians, moved


def trained_so_far(path: Path) -> Run:
    """Return the run in a folder; warn if its training is not finished."""
    from sarsplat.runs import Run

    run = Run.load(path)
    if not run.state.trained:
        console.warn(f"{path} is {run.state}; its result so far is used")
    return run


def refuse_existing(path: Path, overwrite: bool, *, marker: str | None = None) -> None:
    """Raise if an output exists, before minutes of work; `marker` is as for `new_folder`."""
    if marker is not None:
        from sarsplat.data import folders

        folders.refuse_existing(path, overwrite, marker=marker)
        return
    from sarsplat.data.files import refuse_unwritable

    refuse_unwritable(path)
    if overwrite or not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir())):
        return
    raise SarsplatError(f"{path} already exists; choose another name or pass --overwrite")
