"""Errors and warnings for users, and helpers for their sentences."""

from collections.abc import Collection
from difflib import get_close_matches


class SarsplatError(Exception):
    """A mistake in the input, in one sentence: the wrong value and its remedy.

    The command line prints the message without a traceback and exits with code 2.
    """


class SarsplatWarning(UserWarning):
    """A possible mistake that may be intended, in one sentence; the work continues.

    The command line prints the message as one line on stderr.
    """


class AssumptionWarning(SarsplatWarning):
    """An assumption about images, which `source["assumptions"]` of their dataset contains as well.

    The command line prints it among the assumptions.
    """


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 chip`, `2 chips`, `1,200 chips`."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def shown(value: object) -> str:
    """Quote any value for an error: printable, at most 120 characters."""
    text = repr(value).replace("`", "'")  # names in backquotes are our parameters
    return text if len(text) <= 120 else text[:119] + "…"


def advised(name: str, names: Collection[str]) -> str:
    """Return the remedy for an unknown name: `did you mean default?`, or `choose one of a, b`."""
    near = get_close_matches(name, names, 1)
    return f"did you mean {near[0]}?" if near else f"choose one of {', '.join(names)}"
