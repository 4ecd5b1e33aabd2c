"""Commands derived from importers: options from their signatures, help from their docstrings.

Both are read from the source, so that help does not import numpy. Every import ends with assumptions, a sheet of the
orientation, a summary and the next command.
"""

import ast
import re
import shlex
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from inspect import Parameter, Signature, getdoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sarsplat import names
from sarsplat.cli import console
from sarsplat.cli.arguments import Folder, OptionalFile, TargetBox, corners, heights, numbers, one_of, refuse_existing
from sarsplat.cli.commands import first_paragraph
from sarsplat.errors import counted
from sarsplat.extras import install_command

if TYPE_CHECKING:
    from sarsplat.data import Dataset
    from sarsplat.examination.outcome import Examination

CONTRADICTED = 1
"""Exit code if images contradict the dataset."""

_shared: ContextVar[Counter[str] | None] = ContextVar("_shared", default=None)
"""Numbers of datasets by assumption, inside of `assumed_once`."""


@dataclass(frozen=True)
class Option:
    """Command-line form of a parameter, if other than its annotation, default and description imply.

    tyro reads a `kind`, which `value` converts, with the option's name, to the function's argument; `default` is that
    of the option, or the function's if it is `Parameter.empty`.
    """

    kind: Any = None
    value: Callable[[Any, str], Any] = lambda given, _: given
    name: str = ""
    default: Any = Parameter.empty
    help: str = ""


def _typed_without(name: str, help: str) -> Option:
    """Return a switch that turns a default of True off."""
    return Option(bool, lambda off, _: not off, f"no-{name}", False, help)


def comma_separated(metavar: str, counts: tuple[int, ...], example: str) -> Option:
    """Return an option of comma-separated numbers, whose number is one of `counts`; None by default."""
    kind = Annotated[str | None, tyro.conf.arg(metavar=metavar, help_behavior_hint="(optional)")]
    return Option(kind, lambda text, name: None if text is None else numbers(text, name, counts, example), default=None)


def _metres(text: str, name: str) -> float:
    return numbers(text.strip().removesuffix("m"), name, (1,), "64 or 64m")[0]


_NUMBER = Annotated[float, tyro.conf.arg(metavar="NUMBER")]
_SHARED = {
    "out": Option(Folder),
    "size_m": Option(Annotated[str, tyro.conf.arg(metavar="METRES")], _metres),
    "calibration": Option(
        bool,
        lambda absolute, _: "absolute" if absolute else "relative",
        "calibrated",
        False,
        "The power is β⁰ itself, not only up to a factor.",
    ),
    "looks": Option(_NUMBER, lambda looks, _: looks or None, "", 1.0, "Looks of the speckle; 0 if there is none."),
    "ground": _typed_without("ground", "The images show nothing but the target."),
    "terrain": Option(
        OptionalFile,
        lambda path, _: heights(path),
        default=None,
        help="Heights of the ground (GeoTIFF, metres), its middle at the scene's origin unless both say where on earth "
        "they are; level without it.",
    ),
    "target_box_m": Option(TargetBox, lambda box, _: corners(box), default=None),
}
"""Options that several importers have."""
_METAVARS = {"Path": "FILE", "str": "NAME", "int": "N", "float": "NUMBER"}
_UNITS = {"_m": "METRES", "_deg": "DEGREES"}  # metavars by suffixes of parameters


def command_of(module: str, function: str, *, reading: str = "", **options: Option) -> Callable[..., int]:
    """Return the command, of the module `__name__`, that calls an importer.

    `function` is the importer, such as "sarsplat.importers.sicd:import_sicd"; its defaults must be literals. `reading`
    begins the progress message, such as "chips from "; an importer that can be quiet shows its progress. `options` are
    those of parameters that differ from the usual ones, by name.
    """
    home, name = function.split(":")
    stub = _without_body(home, name)
    parameters = signature(stub).parameters
    more, helps = _about(stub.__annotations__.get("about", ""))  # of `**about: Unpack[NAME]`
    helps |= _helps(getdoc(stub) or "")
    made = {}
    for one in sorted((*parameters.values(), *more), key=lambda one: one.name == "overwrite"):  # which is last
        if one.name not in ("quiet", "about"):
            option = options.get(one.name) or _SHARED.get(one.name) or Option()
            made[one.name] = _option(one, replace(option, help=option.help or helps.get(one.name, "")))
    first = next(iter(made))

    def command(**given: Any) -> int:
        importer = getattr(import_module(home), name)
        values = {key: option.value(given[key], option.name) for key, (_, option) in made.items()}
        files, out = values.pop(first), values.pop("out")
        if "quiet" in parameters:
            return _carry_out(importer, files, out, quiet=False, **values)
        what = counted(len(files), "file") if isinstance(files, tuple) else files
        return _carry_out(importer, files, out, doing=f"reading {reading}{what}", **values)

    command.__doc__, command.__module__ = first_paragraph(stub.__doc__), module
    command.__annotations__ = {key: one.annotation for key, (one, _) in made.items()}
    command.__signature__ = Signature([one for one, _ in made.values()])  # type: ignore[attr-defined]
    return command


def _option(one: Parameter, option: Option) -> tuple[Parameter, Option]:
    """Return a parameter for tyro, and the option with its name."""
    if one.default is True and not option.name:
        option = _typed_without(one.name, option.help)
    unit = next((unit for unit in _UNITS if one.name.endswith(unit)), "")
    name = option.name or console.option_name(one.name)
    default = one.default if option.default is Parameter.empty else option.default
    if default is Parameter.empty and one.annotation == "bool":
        default = False
    if default is Parameter.empty and str(one.annotation).endswith("| None"):
        default = None
    kind = option.kind or _kind(one.annotation, default, _UNITS.get(unit))
    if one.kind is Parameter.POSITIONAL_OR_KEYWORD and one.name != "out":
        kind = Annotated[kind, tyro.conf.Positional, tyro.conf.arg(metavar=one.name.upper(), help=option.help)]
    else:
        kind = Annotated[kind, tyro.conf.arg(name=name, help=option.help)]
    return Parameter(one.name, Parameter.KEYWORD_ONLY, default=default, annotation=kind), replace(option, name=name)


def _kind(annotation: str, default: Any, unit: str | None) -> Any:
    """Return the type that tyro reads for an annotation."""
    hint = annotation.replace("str | Path", "Path").replace("Sequence[Path]", "tuple[Path, ...]")
    known = vars(names) | {"Path": Path, "Literal": Literal}
    single = hint.removesuffix(" | None")
    if default is None and single in vars(names):
        return Annotated[eval(hint, known), one_of(eval(single, known))]
    shown = "(optional)" if default is None else "" if single.startswith("tuple") else None
    metavar = unit or _METAVARS.get(single)
    return Annotated[eval(hint, known), tyro.conf.arg(metavar=metavar, help_behavior_hint=shown)]


def _without_body(module: str, name: str) -> Callable[..., Any]:
    """Make a function of this name, signature and docstring, with annotations as strings."""
    source = _source(module)
    head, docstring = source[source.index(f"def {name}(") :].split('"""', 2)[:2]
    known: dict[str, Any] = {}
    exec(f'from __future__ import annotations\n{head}"""{docstring}"""', known)
    function: Callable[..., Any] = known[name]
    return function


def _about(annotation: str) -> tuple[list[Parameter], dict[str, str]]:
    """Return fields of the TypedDict in "Unpack[NAME]", of importers/about.py, and their descriptions."""
    tree = ast.parse(_source("sarsplat.importers.about"))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    fields, helps = list[Parameter](), dict[str, str]()
    name = annotation.removeprefix("Unpack[").removesuffix("]")
    while name in classes:
        stated = [one for one in classes[name].body if isinstance(one, ast.AnnAssign)]
        kinds = {ast.unparse(one.target): ast.unparse(one.annotation) for one in stated}
        fields = [*(Parameter(key, Parameter.KEYWORD_ONLY, annotation=kind) for key, kind in kinds.items()), *fields]
        helps |= _helps(ast.get_docstring(classes[name]) or "")
        name = ast.unparse(classes[name].bases[0])
    return fields, helps


def _source(module: str) -> str:
    spec = find_spec(module)  # which does not import it
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).read_text(encoding="utf-8")


def _helps(docstring: str) -> dict[str, str]:
    """Return the description of each parameter or attribute in a docstring, without references to Python names."""
    docstring = re.split(r"(?:Parameters|Attributes)\n-{10}\n", docstring)[-1]
    section = re.split(r"\n\n\w[\w ]*\n-{3,}\n", docstring)[0]
    entries = re.findall(r"^(\w+)(?: : .*)?\n((?: .*\n?)+)", section, re.MULTILINE)
    return {name: re.sub(r" \(see [^)]*\)", "", " ".join(text.split())) for name, text in entries}


def _carry_out(
    importer: "Callable[..., Dataset]", files: object, out: Path, *, overwrite: bool, doing: str = "", **options: Any
) -> int:
    """Call an importer unless its output exists, and finish; `doing` is the progress message."""
    from sarsplat.data.dataset_folder import HEADER
    from sarsplat.examination.contradictions import examine
    from sarsplat.importers.images import EXAMINATIONS

    refuse_existing(out, overwrite, marker=HEADER)
    contradictions: list[str] = []
    alone = doing and _shared.get() is None  # an import of several shows its own progress
    with _warned_later(contradictions), console.busy(doing) if alone else nullcontext():
        dataset = importer(files, out, overwrite=overwrite, **options)
        examined = EXAMINATIONS.get(dataset) or examine(dataset)
        contradictions += examined.contradictions
    return _finish(out, dataset, examined)


@contextmanager
def assumed_once() -> Iterator[None]:
    """Print assumptions about datasets imported inside the block after it, each with its number of datasets."""
    assumed = Counter[str]()
    token = _shared.set(assumed)
    try:
        yield
        for assumption, number in assumed.items():
            console.say(f"assumed of {counted(number, 'dataset')}: {assumption}")
    finally:
        _shared.reset(token)


@contextmanager
def _warned_later(contradictions: list[str]) -> Iterator[None]:
    """Show warnings inside the block after it, except the contradictions, which are printed as errors."""
    held: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as held:
            yield
    finally:
        for one in held:
            if str(one.message) not in contradictions:
                warnings.showwarning(one.message, one.category, one.filename, one.lineno)


def _finish(out: Path, dataset: "Dataset", examined: "Examination") -> int:
    """Print assumptions and contradictions, draw the orientation sheet, and return 1 if there are contradictions."""
    from sarsplat.data import write_bytes
    from sarsplat.examination.plausible import warn
    from sarsplat.importers import summary
    from sarsplat.regions.target_region import box_misses

    assumed = _shared.get()
    for assumption in dataset.source.get("assumptions", ()):
        if assumed is None:
            console.say(f"assumed: {assumption}")
        else:
            assumed[assumption] += 1
    for text in examined.contradictions:
        console.complain(text)
    warn(box_misses(dataset))
    try:
        from sarsplat.report.sheet import check_sheet

        write_bytes(out / "preview.png", check_sheet(dataset, orientations=examined.orientations))
        arrow = "a target's nose point along the dotted arrow"
        if dataset.place is not None:
            arrow = f"the dotted arrow point to the compass bearing {dataset.place.x_towards_deg:.4g}°"
        console.say(f"look at {out / 'preview.png'}: shadows must fall downwards, and {arrow}")
    except ModuleNotFoundError as error:
        console.say(f"no preview.png was drawn, for {error.name} is not installed; {install_command('report')}")
    folder = shlex.quote(str(out))
    if examined.contradictions:
        console.finish(
            f"{out}: {summary(dataset)}, with {counted(len(examined.contradictions), 'contradiction')}",
            "import again with --overwrite and the options that mend it, or look closer with "
            f"sarsplat check {folder} --verbose",
        )
        return CONTRADICTED
    next_step = f"sarsplat reconstruct {folder} --out {shlex.quote(f'{out}-run')}"
    console.finish(f"{out}: {summary(dataset)}, ready", next_step if assumed is None else None)
    return 0
