"""Frozen records of settings that check every value against the type of its field."""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from difflib import get_close_matches
from functools import cache, partial
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from sarsplat.errors import SarsplatError, shown
from sarsplat.threads import convert


@dataclass(frozen=True)
class Record:
    """Base of records: `msgspec` checks each value against the annotation of its field, ranges included.

    Whole numbers are converted to float, and lists to tuple, as the field needs. Other types and values out of range
    raise.
    """

    _prefix: ClassVar[str] = ""
    """Prefix of its fields in errors, such as ``rates.``."""

    _gone: ClassVar[Mapping[str, str]] = {}
    """Fields of earlier versions, with advice to their users."""

    def __init_subclass__(cls, prefix: str = "") -> None:
        super().__init_subclass__()
        cls._prefix = prefix

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, convert(value, hint))
            except msgspec.ValidationError as error:
                raise SarsplatError(f"{self._prefix}{name} is {shown(value)}; it must be {_allowed(hint)}") from error

    def as_dict(self) -> dict[str, Any]:
        """Convert the record to JSON data."""
        return msgspec.to_builtins(self)

    def changes(self, other: Self) -> Iterator[tuple[str, Any, Any]]:
        """Settings that differ from another record's: dotted names, such as ``rates.means``, with both values."""
        for name in _hints(type(self)):
            own, others = getattr(self, name), getattr(other, name)
            if isinstance(own, Record) and isinstance(others, Record):
                yield from own.changes(others)
            elif own != others:
                yield f"{self._prefix}{name}", own, others

    def with_settings(self, changes: Mapping[str, Any], source: str = "the settings") -> Self:
        """Copy with other values, by dotted names such as ``rates.means``; errors name the `source`.

        As on the command line, "on" or "off" switches an optional record, a value inside of it switches it on, and
        "None" is None.
        """
        data = self.as_dict()
        for name, value in changes.items():
            _set(data, type(self), name, value)
        return type(self).from_dict(data, source)

    @classmethod
    def from_dict(cls, data: object, source: str = "the configuration") -> Self:
        """Make a record from the data of `as_dict`; errors name the `source`, e.g. the path of a file.

        Absent fields take their defaults, as in older files. Raises if a field is unknown, invalid, or missing without
        a default.
        """
        try:
            return _read(data, cls)
        except SarsplatError as error:
            raise SarsplatError(f"{source}: {error}") from error


R = TypeVar("R", bound=Record)


_resolved = cache(partial(get_type_hints, include_extras=True))  # evaluates text, 0.3 ms each time


def _hints(record: type) -> dict[str, Any]:
    hints = _resolved(record)
    return {field.name: hints[field.name] for field in fields(record)}


def record_in(record: type[Record], name: str) -> type[Record] | None:
    """Type of the record in a field, which may be optional; None if the field holds other values."""
    kinds = (kind for kind in _choices(_hints(record)[name]) if isinstance(kind, type))
    return next((kind for kind in kinds if issubclass(kind, Record)), None)


def _choices(hint: Any) -> tuple[Any, ...]:
    """The parts of a union; else the type alone."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _set(data: dict[str, Any], record: type[Record], name: str, value: Any) -> None:
    """Set a value in a record's data by its dotted name; `_read` raises if there is no such setting."""
    first, _, rest = name.partition(".")
    inner = record_in(record, first) if first in _hints(record) else None
    if inner is not None and (rest or value == "on"):
        data[first] = data.get(first) or {}
        if rest:
            _set(data[first], inner, rest, value)
    else:
        data[name] = None if value == "None" or (inner is not None and value == "off") else value


def _read(data: object, record: type[R]) -> R:
    if not isinstance(data, dict):
        raise SarsplatError(f"{shown(data)} is not a set of settings; give an object with {', '.join(_hints(record))}")
    hints, section = _hints(record), record._prefix
    if (gone := next((name for name in data if name in record._gone), None)) is not None:
        raise SarsplatError(f"the setting {section}{gone} is of an earlier version; {record._gone[gone]}")
    if (unknown := next((name for name in data if name not in hints), None)) is not None:
        near = get_close_matches(str(unknown), hints, 1)
        meant = f"did you mean {section}{near[0]}?" if near else "remove it"
        raise SarsplatError(f"the setting {shown(f'{section}{unknown}')} is unknown; {meant}")
    needed = (field.name for field in fields(record) if field.default is field.default_factory is MISSING)
    if missing := next((name for name in needed if name not in data), None):
        raise SarsplatError(f"the setting {section}{missing} is missing; add it")
    inner = {name: kind for name in hints if (kind := record_in(record, name)) is not None}
    return record(**{k: _read(v, inner[k]) if k in inner and isinstance(v, dict) else v for k, v in data.items()})


def _allowed(hint: Any) -> str:
    """Describe the values that a type allows."""
    if get_origin(hint) is Annotated:
        kind, limits = get_args(hint)
        return f"a {'whole ' if kind is int else ''}number from {limits.ge:g} to {limits.le:g}"
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, get_args(hint)))}"
    if get_origin(hint) is tuple and get_args(hint)[-1] is Ellipsis:
        return f"a list, each {_allowed(get_args(hint)[0])}"
    if get_origin(hint) is dict:
        return "a table"
    if hint is bool:
        return "true or false"
    if get_origin(hint) is tuple:
        return f"{len(get_args(hint))} values, each {_allowed(get_args(hint)[0])}"
    if len(_choices(hint)) > 1:
        return " or ".join("nothing" if choice is type(None) else _allowed(choice) for choice in _choices(hint))
    return "text" if hint is str else f"an object with {', '.join(_hints(hint))}"


def dotted(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Flatten nested mappings to dotted names, such as `rates.means`."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
