"""Executes the shape annotations of the package: calls in the tests check their arrays against what is written.

`Float[Tensor, "n 3"]` in a signature or a dataclass says what an array must be, and that equal letters are equal sizes.
A function may refuse a wrong array in its own words (`SarsplatError`); one that accepts it has a wrong annotation or a
missing check, and the test that saw it fails.
"""

import dataclasses
import functools
import importlib
import inspect
import pkgutil
import sys
import types
import typing
from collections import Counter
from collections.abc import Callable

from beartype.door import is_bearable
from jaxtyping import AbstractArray, jaxtyped

import sarsplat

EXECUTED: Counter[str] = Counter()
"""How often the annotations of a function or class were checked, by its full name."""

MOST = 200
"""Calls of one function that are checked; checks of all, a million and a half, took a sixth of the suite's time."""


class ShapeError(AssertionError):
    """An array that its annotation does not allow."""


def watch() -> None:
    """Replace every function and method of the package that has shape annotations by one that checks them."""
    names = [info.name for info in pkgutil.walk_packages(sarsplat.__path__, "sarsplat.")]
    # the engine is no Python
    modules = [importlib.import_module(name) for name in names if not name.endswith("._engine")]
    found: dict[int, Callable] = {}
    for module in modules:
        for value in vars(module).values():
            if getattr(value, "__module__", None) != module.__name__:
                continue
            if inspect.isfunction(value) and shapes_of(value):
                found[id(value)] = watched(value)
            elif inspect.isclass(value):
                _watch_class(value)
    for module in [*modules, sarsplat]:  # whoever imported a function by name gets the watched one
        for name, value in list(vars(module).items()):
            if id(value) in found:
                setattr(module, name, found[id(value)])


def shapes_of(function: Callable) -> dict[str, object]:
    """The annotations that speak of arrays, by parameter; those of other types are the type checker's business."""
    names = {**vars(typing), **vars(sys.modules[function.__module__])}
    found = {}
    for name, hint in getattr(function, "__annotations__", {}).items():
        try:
            found[name] = eval(hint, names) if isinstance(hint, str) else hint
        except (NameError, TypeError, AttributeError):  # what only the type checker imports, or knows how to subscribe
            continue
    return {name: hint for name, hint in found.items() if _speaks_of_arrays(hint)}


def _speaks_of_arrays(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(_speaks_of_arrays(part) for part in typing.get_args(hint))


def watched(function: types.FunctionType) -> Callable:
    """The same function, checking its arrays on the way in and out."""
    shapes, names = shapes_of(function), [*inspect.signature(function).parameters]
    name = f"{function.__module__}.{function.__qualname__}"

    # `jaxtyped` gives the sizes of one call a common memory; sizes in braces, {grid.rows}, refer to its arguments
    @jaxtyped(typechecker=None)
    @functools.wraps(function)
    def call(*arguments: object, **options: object) -> object:
        given = {**dict(zip(names, arguments)), **options}
        wrong = [key for key, shape in shapes.items() if key in given and not is_bearable(given[key], shape)]
        result = function(*arguments, **options)  # may refuse by itself
        if wrong:
            raise ShapeError(f"{name} accepted {', '.join(wrong)}: not of the shape in its annotation")
        if "return" in shapes and not is_bearable(result, shapes["return"]):
            raise ShapeError(f"{name} returned something else than {shapes['return']}")
        EXECUTED[name] += 1
        return result

    return _first_calls(call, function, name)


def _first_calls(checked: Callable, plain: Callable, name: str) -> Callable:
    """The checked function until it was called often enough, then the plain one."""

    @functools.wraps(plain)
    def function(*arguments: object, **options: object) -> object:
        return (checked if EXECUTED[name] < MOST else plain)(*arguments, **options)

    return function


def _watch_class(cls: type) -> None:
    fields = {f.name for f in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else set()
    generated = {"__init__"} if fields else set()  # a dataclass's is checked by its fields, after what it refuses
    for name, member in list(vars(cls).items()):
        function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if isinstance(member, property) and member.fget is not None and shapes_of(member.fget):
            setattr(cls, name, property(watched(member.fget), doc=member.__doc__))
        elif inspect.isfunction(function) and shapes_of(function) and name not in generated:
            replacement = watched(function)
            setattr(cls, name, replacement if member is function else type(member)(replacement))
    shapes = {name: hint for name, hint in shapes_of(cls).items() if name in fields}
    if shapes:
        _watch_fields(cls, shapes)


def _watch_fields(cls: type, shapes: dict[str, object]) -> None:
    """Check a dataclass's fields once it stands."""
    initialise = cls.__init__
    name = f"{cls.__module__}.{cls.__qualname__}"

    @jaxtyped(typechecker=None)
    @functools.wraps(initialise)
    def checked(self: object, *arguments: object, **options: object) -> None:
        initialise(self, *arguments, **options)  # may refuse by itself
        wrong = [field for field, shape in shapes.items() if not is_bearable(getattr(self, field), shape)]
        if wrong:
            raise ShapeError(f"{cls.__name__} took {', '.join(wrong)}: not of the shape in its annotation")
        EXECUTED[name] += 1

    cls.__init__ = _first_calls(checked, initialise, name)
