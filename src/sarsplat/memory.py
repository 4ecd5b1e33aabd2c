"""Memory checks before large work: announce its need, or raise if that exceeds the free memory."""

from collections.abc import Iterator
from pathlib import Path

from sarsplat.errors import SarsplatError

_STATED_GIB, _STATED_SHARE = 1.0, 0.25  # minimum need that is announced, GiB and relative to the free memory

_SYSTEM = Path("/")
_CGROUPS = (  # version 2, and 1: prefix of its line in /proc/self/cgroup, its folder, its files
    ("0::", "sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
    (":memory:", "sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


def required(what: str, needed_bytes: float, remedy: str) -> str | None:
    """Return a line on the memory that `what`, such as "extracting the surface", will take; None if that is little.

    `needed_bytes` is the estimated peak beyond the memory in use. Raise if it exceeds the free memory; `remedy`, how to
    need less, ends the error.
    """
    free, needed = free_bytes() / 2**30, needed_bytes / 2**30
    if needed > free:
        raise SarsplatError(f"{what} takes about {needed:.2g} GiB of memory, and {free:.2g} GiB are free; {remedy}")
    if needed < min(_STATED_GIB, _STATED_SHARE * free):
        return None
    return f"{what} takes about {needed:.2g} GiB of memory, of {free:.3g} GiB that are free"


def free_bytes() -> float:
    """Return the memory available to this process without swapping, within the machine and its container."""
    import psutil  # here, because help does not need it

    return min([float(psutil.virtual_memory().available), *_left_in_groups(_SYSTEM)])


def _left_in_groups(system: Path) -> Iterator[float]:
    """Yield the memory left in each Linux control group of this process; `system` is the root folder."""
    try:
        lines = (system / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # another system
        return
    for mark, folder, limit, used, cached in _CGROUPS:
        for line in lines:
            if mark not in line:
                continue
            group, top = system / folder / line.partition(mark)[2].lstrip("/"), system / folder
            for place in (group, *group.parents):
                try:
                    allowed = float((place / limit).read_text().replace("max", "inf"))
                    statistics = dict(row.split() for row in (place / "memory.stat").read_text().splitlines())
                    yield allowed - float((place / used).read_text()) + float(statistics.get(cached, 0))
                except (OSError, ValueError):  # no limits here, as at the root
                    pass
                if place == top:
                    break
