"""Protocols of jobs and executors, which are modules `executor_NAME.py` and entry points."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from sarsplat.errors import SarsplatError, advised, shown
from sarsplat.plugins import discover


class Job(Protocol):
    """An independent job: a `msgspec.Struct`, sent as JSON to a worker."""

    work: ClassVar[str]
    """Address of its `Work`, `module:NAME`."""

    @property
    def address(self) -> str:
        """Unique name among the jobs of a call."""

    @property
    def device(self) -> str:
        """Device type: cpu or cuda."""


@dataclass(frozen=True)
class Work:
    """A kind of job, with the functions that do it.

    Parameters
    ----------
    job, result : type
        Types of its jobs and their results, each a `msgspec.Struct`.
    do : callable
        (job, output folder of all jobs, retry failed ones) → its result, or None if another process is doing the job.
        Must not raise.
    lost : callable
        (job, output folder, reason) → result of a job whose process has ended, or None likewise.
    go_on : str
        Remedy for a lost job, the end of an error's sentence.
    """

    job: type[Any]
    result: type[Any]
    do: Callable[[Any, Path, bool], Any]
    lost: Callable[[Any, Path, str], Any]
    go_on: str


J = TypeVar("J", bound=Job)


@dataclass(frozen=True)
class Means:
    """Resources of an executor; each executor uses the ones that it knows.

    Parameters
    ----------
    processes : int or None
        Jobs at a time on the CPU of this machine; None: one for each processor.
    address : str
        Address of the Ray cluster, as in `ray.init`; "auto": the one running here.
    gpus : float or None
        GPUs per job on a Ray cluster: 0.25 lets four jobs share one; None: 1 on cuda.
    retries : int
        Maximum restarts by Ray of a job whose node or process has died.
    again : bool
        Retry failed runs of a sweep.
    per_device : int or None
        Jobs at a time on each GPU of this machine, in one process; None: up to four, limited by processors.
    """

    processes: int | None = None
    address: str = "auto"
    gpus: float | None = None
    retries: int = 3
    again: bool = False
    per_device: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("processes", 1), ("per_device", 1), ("gpus", 0), ("retries", 0)):
            value = getattr(self, name)
            if value is not None and not least <= value < float("inf"):
                raise SarsplatError(f"{name} is {value}; give a finite number from {least}")


class Executor(Protocol):
    """Executor of jobs: runs the `do` of their work in processes with one engine thread; GPUs may be shared."""

    def __call__(self, jobs: Sequence[J], out: Path, means: Means) -> Iterator[tuple[J, Any]]:
        """Yield every job, all of one work, with its result as it ends; None if another process is doing the job.

        Unfinished jobs are stopped when the iterator is closed or raises.
        """


EXECUTORS = discover("sarsplat.executors", "executor_", "run", "sarsplat.executors")
"""Executors by name, as on the command line; imported at first use."""


def executor_named(name: str) -> Executor:
    """Return one of `EXECUTORS`; raise for unknown names."""
    if name not in EXECUTORS:
        raise SarsplatError(f"executor {shown(name)} is unknown; {advised(name, EXECUTORS)}")
    executor: Executor = EXECUTORS[name]
    return executor


def work_named(name: str) -> Work:
    """Import the `Work` of a `Job.work`."""
    module, _, attribute = name.partition(":")
    work: Work = getattr(import_module(module), attribute)
    return work
