"""Parts and strategies are found in their folders: each is one file, and nothing else lists it."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import TypeVar

T = TypeVar("T")


def classes_in(package: str, base: type[T]) -> tuple[type[T], ...]:
    """Every class derived from `base` that another module of the package defines, by its `order`."""
    modules = [import_module(f"{package}.{info.name}") for info in iter_modules(import_module(package).__path__)]
    kinds = [
        kind
        for module in modules
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, base) and kind.__module__ == module.__name__ != base.__module__
    ]
    return tuple(sorted(kinds, key=lambda kind: kind.order))  # type: ignore[attr-defined]
