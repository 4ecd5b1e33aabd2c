"""Strict reading of JSON objects: every field present, none unknown, each of the right type."""

from __future__ import annotations

from sarsplat.errors import SarsplatError, shown


class Fields:
    """One JSON object whose fields are asked for by name and type.

    Parameters
    ----------
    value : object
        What the JSON holds.
    where : str
        What to call it in errors, e.g. ``views[3]``.
    names : tuple of str
        The fields it must have; it may have no others.

    Raises
    ------
    SarsplatError
        If it is no object, or a field is missing or unknown; the methods, if a field has the wrong type.
    """

    def __init__(self, value: object, where: str, names: tuple[str, ...]) -> None:
        if not isinstance(value, dict):
            raise SarsplatError(f"{where} is {shown(value)} but must be an object with the fields {', '.join(names)}")
        if missing := [name for name in names if name not in value]:
            raise SarsplatError(f"{where} lacks the field {missing[0]!r}; add it or make the file again")
        if unknown := [name for name in value if name not in names]:
            raise SarsplatError(f"{where} has the unknown field {shown(unknown[0])}; it may have {', '.join(names)}")
        self._value, self._where = value, where

    def _wrong(self, name: str, expected: str) -> SarsplatError:
        return SarsplatError(f"{self._where}.{name} is {shown(self._value[name])} but must be {expected}")

    def text(self, name: str, *allowed: str) -> str:
        """A string, one of `allowed` if any are named."""
        value = self._value[name]
        if not isinstance(value, str) or (allowed and value not in allowed):
            raise self._wrong(name, " or ".join(map(repr, allowed)) if allowed else "text")
        return value

    def integer(self, name: str) -> int:
        """A whole number."""
        value = self._value[name]
        if not isinstance(value, int) or isinstance(value, bool):
            raise self._wrong(name, "a whole number")
        return value

    def number(self, name: str) -> float:
        """A number."""
        value = self._value[name]
        if not _is_number(value):
            raise self._wrong(name, "a number")
        return float(value)

    def number_or_null(self, name: str) -> float | None:
        """A number, or None for null."""
        return None if self._value[name] is None else self.number(name)

    def pair(self, name: str) -> tuple[float, float]:
        """Two numbers."""
        value = self._value[name]
        if not isinstance(value, list) or len(value) != 2 or not all(map(_is_number, value)):
            raise self._wrong(name, "a pair of numbers")
        return float(value[0]), float(value[1])

    def items(self, name: str) -> list[object]:
        """A list."""
        value = self._value[name]
        if not isinstance(value, list):
            raise self._wrong(name, "a list")
        return value

    def mapping(self, name: str) -> dict[str, object]:
        """An object, as it is."""
        value = self._value[name]
        if not isinstance(value, dict):
            raise self._wrong(name, "an object")
        return value

    def get(self, name: str) -> object:
        """The field, of whatever type."""
        return self._value[name]


def _is_number(value: object) -> bool:
    # The bound keeps float() from overflowing on an integer of hundreds of digits.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
