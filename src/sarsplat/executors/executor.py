"""Jobs, the kinds of work that they are, and executors of them: modules `executor_NAME.py` here, and entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from sarsplat.errors import SarsplatError, advised, shown
from sarsplat.plugins import discover


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


J = TypeVar("J", bound=Job)


@dataclass(frozen=True)
class Means:
    """What an executor may use; each takes what concerns it.

    Parameters
    ----------
    processes : int or None
        Jobs at a time on the CPU of this machine; None: as many as there are processors.
    address : str
        Of the Ray cluster, as in `ray.init`; "auto" is the one that is running here.
    gpus : float or None
        GPUs of a job on a Ray cluster: 0.25 lets four of them share one; None: one if its device is cuda.
    retries : int
        How often Ray starts a job again whose node or process has died.
    again : bool
        Whether failed runs of a sweep are tried again.
    per_device : int or None
        Jobs at a time on each GPU of this machine, in one process; None: four, or as many as it has processors.
    """

    processes: int | None = None
    address: str = "auto"
    gpus: float | None = None
    retries: int = 3
    again: bool = False
    per_device: int | None = None

    def __post_init__(self) -> None:
        for name, count in (("processes", self.processes), ("per_device", self.per_device)):
            if count is not None and count < 1:
                raise SarsplatError(f"{name} is {count}; give at least 1")
        if self.gpus is not None and not 0 <= self.gpus < float("inf"):
            raise SarsplatError(f"gpus is {self.gpus}; give a share of a GPU such as 0.25, or a whole number")
        if self.retries < 0:
            raise SarsplatError(f"retries is {self.retries}; give 0 or more")


class Executor(Protocol):
    """Does jobs, each by the `do` of its work in a process that has one thread of the engine; GPUs may be shared."""

    def __call__(self, jobs: Sequence[J], out: Path, means: Means) -> Iterator[tuple[J, Any]]:
        """Yield every job, all of one work, with its result as it ends; None where another process is at it.

        What is left undone when the iterator is closed, or an exception leaves it, is stopped at once.
        """


EXECUTORS = discover("sarsplat.executors", "executor_", "run", "sarsplat.executors")
"""By name, as on the command line; each is imported when it is asked for."""


def executor_named(name: str) -> Executor:
    """One of `EXECUTORS`; a SarsplatError if there is none of that name."""
    if name not in EXECUTORS:
        raise SarsplatError(f"executor {shown(name)} is unknown; {advised(name, EXECUTORS)}")
    executor: Executor = EXECUTORS[name]
    return executor


def work_named(name: str) -> Work:
    """The work of a `Job.work`."""
    module, _, attribute = name.partition(":")
    work: Work = getattr(import_module(module), attribute)
    return work
