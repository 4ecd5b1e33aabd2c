"""Memory: what is free, in a container too, and what is said of work that takes much of it."""

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from sarsplat import memory
from sarsplat.errors import SarsplatError

GIB = 2**30


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The root of a machine with 64 GiB free and without control groups."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=64 * GIB))
    monkeypatch.setattr(memory, "_SYSTEM", tmp_path)
    return tmp_path


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def test_the_tightest_of_machine_and_groups_counts(system: Path) -> None:
    assert memory.free_bytes() == 64 * GIB
    write(system, {"proc/self/cgroup": "0::/pod/work\n"})
    groups = system / "sys/fs/cgroup"
    used = {"memory.current": f"{3 * GIB}", "memory.stat": f"anon {2 * GIB}\ninactive_file {GIB}\n"}
    write(groups / "pod/work", {"memory.max": "max\n", **used})
    assert memory.free_bytes() == 64 * GIB
    write(groups / "pod", {"memory.max": f"{10 * GIB}\n", **used})
    assert memory.free_bytes() == 8 * GIB  # what files take can be had back


def test_the_older_groups_count_too(system: Path) -> None:
    write(system, {"proc/self/cgroup": "12:cpu,cpuacct:/a\n9:memory:/a\n"})
    files = {"limit_in_bytes": f"{4 * GIB}", "usage_in_bytes": f"{GIB}", "stat": "total_inactive_file 0"}
    write(system / "sys/fs/cgroup/memory/a", {f"memory.{name}": text for name, text in files.items()})
    assert memory.free_bytes() == 3 * GIB


def test_much_is_said_and_too_much_refused(system: Path) -> None:
    assert memory.required("this", 0.9 * GIB, "take less") is None
    assert memory.required("this", 2 * GIB, "take less") == "this takes about 2 GiB of memory, of 64 GiB that are free"
    with pytest.raises(SarsplatError, match=r"^this takes about 65 GiB of memory, and 64 GiB are free; take less$"):
        memory.required("this", 65 * GIB, "take less")
