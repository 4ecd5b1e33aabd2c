"""Argument checks of public functions against their annotations."""

import math
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

_REMEDIES = {
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
"""Name of an expected type → remedy."""

_NUMBERS = {float: Real, int: Integral, bool: Integral}
_SEQUENCES = (Sequence, Iterable, tuple)
_SCALARS = (str, bytes, os.PathLike)  # iterable types that are no sequences of arguments


@typing.overload
def checks_arguments(function: F) -> F: ...
@typing.overload
def checks_arguments(*, instead: Callable[[str, object], str | None]) -> Callable[[F], F]: ...
def checks_arguments(function: Any = None, *, instead: Callable[[str, object], str | None] | None = None) -> Any:
    """Decorate a function to raise a SarsplatError for arguments of other types than its annotations.

    Types are classes, paths, numbers, choices, arrays, functions, mappings and sequences of them, and the fields of a
    `TypedDict` (`**options: Unpack[...]`). Shapes and ranges are left to the function. An unknown name is a TypeError,
    as usual; `instead` may return the remedy for that name and value.
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
            remedy = None if instead is None else instead(unknown, options[unknown])
            remedy = remedy or advised(unknown, [name for name in known if name not in ("return", "self")])
            raise TypeError(f"{function.__name__}() got an unexpected keyword argument {unknown!r}; {remedy}")
        for name, value in (*zip(names, arguments, strict=False), *options.items()):
            if name in kinds:
                _expect(kinds[name], name, value)
        return function(*arguments, **options)

    return checked


def expect(kind: Any, **values: object) -> None:
    """Raise for values that are not of a type, as `checks_arguments` does."""
    for name, value in values.items():
        _expect(tuple(_alternatives(kind)), name, value)


def expect_fields(record: object) -> None:
    """Raise for fields of a dataclass that are not of their annotated types, as `checks_arguments` does."""
    for name, value in vars(record).items():
        _expect(_kinds(type(record).__init__)[name], name, value)


def _expect(kinds: Sequence[Any], name: str, value: object) -> None:
    if type(value) not in kinds and not _fits(value, kinds):  # the first test is cheap
        raise SarsplatError(f"{name} {_error(value, kinds)}")


def check_number(name: str, value: float, low: float, high: float = math.inf, *, above: bool = False) -> None:
    """Raise unless a number is finite and from `low`, or `above` it, to `high`; the name may end with `in UNIT`."""
    if not ((low < value if above else low <= value) and value <= high and value < math.inf):
        limits = [f"above {low:g}" if above else f"of at least {low:g}", f"at most {high:g}" if high < math.inf else ""]
        raise SarsplatError(f"{name} is {value}; give a number {' and '.join(filter(None, limits))}")


def is_number(value: object) -> bool:
    """Return whether a value is a real number; True and False are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def described(value: object) -> str:
    """Quote a value for an error; if that is long or an address in memory, its type and shape."""
    shape, text = getattr(value, "shape", None), repr(value)
    if not isinstance(shape, tuple) and len(text) <= 120 and " at 0x" not in text:
        return text
    return f"an object of type {type(value).__name__}" + (f" {list(shape)}" if isinstance(shape, tuple) else "")


@cache
def _kinds(function: Callable[..., Any]) -> dict[str, tuple[Any, ...]]:
    """Return the types that each parameter accepts; classes imported only for type checkers by name."""
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
    """Yield the members of a union, or the annotation itself; generic ones with their parameters, new types by name."""
    if typing.get_origin(hint) in (UnionType, typing.Union):
        for part in typing.get_args(hint):
            yield from _alternatives(part)
    elif isinstance(hint, typing.NewType):
        yield hint.__name__
    else:
        yield getattr(hint, "array_type", None if hint is NoneType else hint)  # jaxtyping's


def _fits(value: object, kinds: Iterable[Any]) -> bool:
    return any(_is_a(value, kind) for kind in kinds)


def _is_a(value: object, kind: Any) -> bool:
    if kind is None or isinstance(kind, str):
        return value is kind or any(cls.__name__ == kind for cls in type(value).__mro__)
    origin = typing.get_origin(kind) or kind
    if origin is Literal:
        return any(
            isinstance(value, type(choice)) and isinstance(value, bool) == isinstance(choice, bool) and value == choice
            for choice in typing.get_args(kind)
        )
    if origin is Callable:
        return callable(value)
    if origin in _SEQUENCES:
        if isinstance(value, _SCALARS) or not isinstance(value, Iterable):
            return False
        if isinstance(value, Iterator):
            return True
        if (of := getattr(value, "item_type", None)) is not None:  # without iterating, which may be slow
            return of in _items(kind)
        values = [*value]
        return len(values) == (_tuple_length(kind) or len(values)) and all(_fits(item, _items(kind)) for item in values)
    if not isinstance(origin, type) or origin is Any or getattr(origin, "_is_protocol", False):
        return True  # Any, or checked by the function itself
    if origin in _NUMBERS:
        number = isinstance(value, _NUMBERS[origin]) or getattr(value, "shape", None) == ()
        return number and (
            origin is bool or (not isinstance(value, bool) and "bool" not in str(getattr(value, "dtype", "")))
        )
    return isinstance(value, os.PathLike if origin is Path else origin)


def _items(kind: Any) -> tuple[Any, ...]:
    """Return the types that each item of a sequence may have."""
    return tuple(_alternatives(next(iter(typing.get_args(kind)), Any)))


def _tuple_length(kind: Any) -> int:
    """Return the length of a tuple type, or 0 for any length."""
    members = typing.get_args(kind)
    return 0 if typing.get_origin(kind) is not tuple or ... in members else len(members)


def _error(value: object, kinds: Sequence[Any]) -> str:
    """Return the error for a value of a wrong type: the value and its remedy."""
    for kind in kinds:
        if typing.get_origin(kind) in _SEQUENCES:
            items = _items(kind)
            if Any not in items and not _tuple_length(kind) and _fits(value, items):
                return f"is a single one, {described(value)}; put it into a list"
            if isinstance(value, Iterable) and not isinstance(value, _SCALARS):
                for wrong in (item for item in value if not _fits(item, items)):
                    return f"holds {described(wrong)}; make each {_remedy(items)}"
    return f"is {described(value)}; give {_remedy(kinds)}"


def _remedy(kinds: Sequence[Any]) -> str:
    named = [kind for kind in kinds if kind is not None and not (kind is str and Path in kinds)]
    return " or ".join(_remedy_of(kind) for kind in named)


def _remedy_of(kind: Any) -> str:
    origin, members = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is Literal:
        return f"{'one of ' if len(members) > 1 else ''}{', '.join(map(repr, members))}"
    if origin in _SEQUENCES:
        return f"{f'{number} values' if (number := _tuple_length(kind)) else 'a list'}, each {_remedy(_items(kind))}"
    name = kind if isinstance(kind, str) else origin.__name__
    return _REMEDIES.get(name, f"an object of the class {name}")
