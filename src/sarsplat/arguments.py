"""Argument checks of public functions: an argument of another type than its annotation is refused in one sentence."""

from __future__ import annotations

import os
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial, wraps
from inspect import signature
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar

from sarsplat.errors import SarsplatError, advised

F = TypeVar("F", bound=Callable[..., Any])

_GIVE = {
    "Callable": "a function, not its name",
    "Config": "a Config, such as preset('default')",
    "Dataset": "a Dataset, such as read_dataset(PATH) reads",
    "Footprints": "Footprints, such as Projection.pixels",
    "Gaussians": "Gaussians, such as read_gaussians_ply(PATH) reads",
    "ImageGrid": "an ImageGrid(rows, columns, spacing_m, resolution_m)",
    "Mapping": "a dict",
    "Path": "a path, a str or a pathlib.Path",
    "Projection": "what sarsplat.project returned",
    "RayGrid": "a RayGrid, such as RayGrid.for_image(grid)",
    "Response": "Gaussian() or Taylor()",
    "Run": "a Run, as reconstruct returns or Run.load(PATH) reads",
    "SarImage": "a SarImage(power, view, grid)",
    "Scattering": "a law with its parameters, such as Harmonics(torch.zeros(n, 16))",
    "Tensor": "a torch.Tensor (torch.as_tensor makes one)",
    "Trimesh": "a trimesh.Trimesh, such as load_mesh(PATH) reads",
    "View": "a View(azimuth_deg, grazing_deg)",
    "bool": "True or False",
    "float": "a number",
    "int": "a whole number",
    "ndarray": "a numpy.ndarray (numpy.asarray makes one)",
    "str": "a str",
}
"""The remedy, by the name of the kind that was expected."""

_NUMBERS = {float: Real, int: Integral, bool: Integral}
_SERIES = (Sequence, Iterable, tuple)
_ONE_THING = (str, bytes, os.PathLike)
"""What Python iterates over, or opens, but nobody means as a sequence."""


@typing.overload
def checks_arguments(function: F) -> F: ...
@typing.overload
def checks_arguments(*, instead: Callable[[str, object], str | None]) -> Callable[[F], F]: ...
def checks_arguments(function: Any = None, *, instead: Callable[[str, object], str | None] | None = None) -> Any:
    """Decorate a function so that it refuses arguments of other types than its annotations name.

    Kinds are classes, paths, numbers, arrays, functions, mappings and sequences of them, and what a `TypedDict` holds
    (`**options: Unpack[...]`). Shapes, ranges and choices are left to the function; it raises a SarsplatError in
    either case, here before anything is done. A name that it does not have is a TypeError, as of any function;
    `instead` may know where what is so named, with this value, is to be given.
    """
    if function is None:
        return partial(checks_arguments, instead=instead)
    names = [*signature(function).parameters]
    closed = any("Unpack[" in str(hint) for hint in function.__annotations__.values())
    open_to_all = not closed and any(one.kind is one.VAR_KEYWORD for one in signature(function).parameters.values())

    @wraps(function)
    def checked(*arguments: Any, **options: Any) -> Any:
        kinds = _kinds(function)
        known = kinds.keys() if closed else names
        if not open_to_all and (unknown := next((name for name in options if name not in known), None)) is not None:
            told = None if instead is None else instead(unknown, options[unknown])
            remedy = told or advised(unknown, [name for name in known if name not in ("return", "self")])
            raise TypeError(f"{function.__name__}() got an unexpected keyword argument {unknown!r}; {remedy}")
        for name, value in (*zip(names, arguments, strict=False), *options.items()):
            if name in kinds:
                _expect(kinds[name], name, value)
        return function(*arguments, **options)

    return checked


def expect(kind: Any, **values: object) -> None:
    """Refuse values that are not of a type; names and wording as in `checks_arguments`."""
    for name, value in values.items():
        _expect(tuple(_alternatives(kind)), name, value)


def _expect(kinds: Sequence[Any], name: str, value: object) -> None:
    if type(value) not in kinds and not _fits(value, kinds):  # the first is usual, and cheap
        raise SarsplatError(f"{name} {_instead(value, kinds)}")


def is_number(value: object) -> bool:
    """Whether a value is a real number; True and False are none, although Python counts with them."""
    return isinstance(value, Real) and not isinstance(value, bool)


def described(value: object) -> str:
    """The value as an error quotes it; where that is long, or an address in memory, its type and shape."""
    shape, text = getattr(value, "shape", None), repr(value)
    if not isinstance(shape, tuple) and len(text) <= 120 and " at 0x" not in text:
        return text
    return f"an object of type {type(value).__name__}" + (f" {list(shape)}" if isinstance(shape, tuple) else "")


@cache
def _kinds(function: Callable[..., Any]) -> dict[str, tuple[Any, ...]]:
    """The types that each parameter accepts; a class that is imported for type checkers alone is given by its name."""
    known = vars(sys.modules[function.__module__])
    kinds: dict[str, tuple[Any, ...]] = {}
    for name, hint in function.__annotations__.items():
        try:
            kind = eval(hint, known) if isinstance(hint, str) else hint
            if typing.get_origin(kind) is typing.Unpack:
                named = typing.get_type_hints(typing.get_args(kind)[0])
                kinds |= {one: tuple(_alternatives(its)) for one, its in named.items()}
            else:
                kinds[name] = tuple(_alternatives(kind))
        except NameError:
            parts = [part.strip().rpartition(".")[2] for part in hint.split("|")]
            kinds[name] = tuple(None if part == "None" else part for part in parts)
    return kinds


def _alternatives(hint: Any) -> Iterator[Any]:
    """What an annotation allows, one by one: classes, and sequences, mappings and functions as they are written."""
    if typing.get_origin(hint) in (UnionType, typing.Union):
        for part in typing.get_args(hint):
            yield from _alternatives(part)
    else:
        yield getattr(hint, "array_type", None if hint is NoneType else hint)  # jaxtyping's


def _fits(value: object, kinds: Iterable[Any]) -> bool:
    return any(_is(value, kind) for kind in kinds)


def _is(value: object, kind: Any) -> bool:
    if kind is None or isinstance(kind, str):
        return value is kind or any(cls.__name__ == kind for cls in type(value).__mro__)
    origin = typing.get_origin(kind) or kind
    if origin is Literal:
        return isinstance(value, tuple(type(choice) for choice in typing.get_args(kind)))
    if origin is Callable:
        return callable(value)
    if origin in _SERIES:
        if isinstance(value, _ONE_THING) or not isinstance(value, Iterable):
            return False
        if isinstance(value, Iterator):
            return True
        if (of := getattr(value, "item_type", None)) is not None:  # it says so, and may not be looked through
            return of in _items(kind)
        values = [*value]
        return len(values) == (_fixed(kind) or len(values)) and all(_fits(item, _items(kind)) for item in values)
    if not isinstance(origin, type) or origin is Any or getattr(origin, "_is_protocol", False):
        return True  # what anything is, or the function sees to itself
    if origin in _NUMBERS:
        number = isinstance(value, _NUMBERS[origin]) or getattr(value, "shape", None) == ()
        return number and (
            origin is bool or (not isinstance(value, bool) and "bool" not in str(getattr(value, "dtype", "")))
        )
    return isinstance(value, os.PathLike if origin is Path else origin)


def _items(kind: Any) -> tuple[Any, ...]:
    """The types that each item of a sequence may have."""
    return tuple(_alternatives(next(iter(typing.get_args(kind)), Any)))


def _fixed(kind: Any) -> int:
    """How many values a tuple must hold, all of one kind; 0: any number."""
    members = typing.get_args(kind)
    return 0 if typing.get_origin(kind) is not tuple or ... in members else len(members)


def _instead(value: object, kinds: Sequence[Any]) -> str:
    """The error sentence for a value of a wrong type: what was given, and what to give."""
    for kind in kinds:
        if typing.get_origin(kind) in _SERIES:
            items = _items(kind)
            if Any not in items and not _fixed(kind) and _fits(value, items):
                return f"is a single one, {described(value)}; put it into a list"
            if isinstance(value, Iterable) and not isinstance(value, _ONE_THING):
                for wrong in (item for item in value if not _fits(item, items)):
                    return f"holds {described(wrong)}; make each {_wanted(items)}"
    return f"is {described(value)}; give {_wanted(kinds)}"


def _wanted(kinds: Sequence[Any]) -> str:
    some = [kind for kind in kinds if kind is not None and not (kind is str and Path in kinds)]
    return " or ".join(_remedy(kind) for kind in some)


def _remedy(kind: Any) -> str:
    origin, members = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(map(repr, members))}"
    if origin in _SERIES:
        return f"{f'{number} values' if (number := _fixed(kind)) else 'a list'}, each {_wanted(_items(kind))}"
    name = kind if isinstance(kind, str) else origin.__name__
    return _GIVE.get(name, f"an object of the class {name}")
