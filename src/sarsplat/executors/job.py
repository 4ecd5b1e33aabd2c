"""Jobs: what an executor does somewhere; and the kinds of work that they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Protocol


class Job(Protocol):
    """A piece of work that does not need the others: a `msgspec.Struct`, sent as JSON to whoever does it."""

    work: ClassVar[str]
    """Its kind, `module:NAME` of a `Work`."""

    @property
    def address(self) -> str:
        """By which it is known among the others."""

    @property
    def device(self) -> str:
        """Where it is done: cpu or cuda."""


@dataclass(frozen=True)
class Work:
    """A kind of work.

    Parameters
    ----------
    job, result : type
        Of its jobs and their results: both a `msgspec.Struct`.
    do : callable
        Do a job: given it, the folder that all of them write to, and whether what failed is tried again. Its result;
        None if another process is doing it. It raises nothing.
    lost : callable
        The result of a job whose process has ended, given it, the folder and the reason; None likewise.
    go_on : str
        How to go on with what was lost, for errors: the end of a sentence.
    """

    job: type[Any]
    result: type[Any]
    do: Callable[[Any, Path, bool], Any]
    lost: Callable[[Any, Path, str], Any]
    go_on: str


def work_named(name: str) -> Work:
    """The work of a `Job.work`."""
    module, _, attribute = name.partition(":")
    work: Work = getattr(import_module(module), attribute)
    return work
