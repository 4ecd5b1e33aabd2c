"""Whole or absent files, and JSON."""

import errno
import os
import signal
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from programs import elsewhere
from sarsplat.data.files import locked, read_json, refuse_unwritable, write_bytes, write_json
from sarsplat.errors import SarsplatError


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_write_bytes_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.bin"
    write_bytes(path, b"one")
    (tmp_path / ".a.bin.sarsplat-tmp").write_bytes(b"half of something longer, which a killed process left")
    for own in (".a.bin.tmp", ".a.bin.lock"):  # of the user
        (tmp_path / own).touch()
    write_bytes(path, b"two")
    assert path.read_bytes() == b"two"
    assert names(tmp_path) == [".a.bin.lock", ".a.bin.tmp", "a.bin"]


def test_write_bytes_refuses_while_another_writes(tmp_path):
    tmp_path /= "any.tmpdir"
    tmp_path.mkdir()
    path = tmp_path / "a.bin"
    with elsewhere(locked(path)), pytest.raises(SarsplatError, match=r"a\.bin is in use by another process"):
        write_bytes(path, b"new")
    assert names(tmp_path) == []
    write_bytes(path, b"new")
    assert names(tmp_path) == ["a.bin"]


def test_who_holds_a_lock_may_come_again(tmp_path):
    path = tmp_path / "a"
    (tmp_path / "link").symlink_to(path)
    with locked(path):
        with locked(tmp_path / "link"):
            write_bytes(path, b"mine")
        with pytest.raises(SarsplatError, match="in use"), elsewhere(locked(path)):
            pass
        assert (tmp_path / ".a.sarsplat-lock").exists()
    with elsewhere(locked(path)):
        pass
    assert names(tmp_path) == ["a", "link"]


def test_a_killed_process_leaves_no_stale_lock(tmp_path):
    if (child := os.fork()) == 0:
        with locked(tmp_path / "a"):
            os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert names(tmp_path) == [".a.sarsplat-lock"]
    write_bytes(tmp_path / "a", b"new")
    assert names(tmp_path) == ["a"]


def test_a_link_under_the_temporary_name_is_not_followed(tmp_path):
    (tmp_path / "other").write_text("other")
    (tmp_path / ".a.sarsplat-tmp").symlink_to("other")
    write_bytes(tmp_path / "a", b"new")
    assert ((tmp_path / "other").read_text(), (tmp_path / "a").read_text()) == ("other", "new")


def test_devices_and_pipes_are_never_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    (tmp_path / "null").symlink_to("/dev/null")
    for name in ("pipe", "dangling", "null"):
        with pytest.raises(SarsplatError, match="a device, a pipe or a broken link"):
            write_bytes(tmp_path / name, b"")
    assert names(tmp_path) == ["dangling", "null", "pipe"]


REASONS = {errno.ENOSPC: "disk is full", errno.EROFS: "read-only", errno.EACCES: "permission", errno.EIO: "check the"}


@pytest.mark.parametrize(
    ("error", "raised", "words"),
    [
        *((OSError(number, os.strerror(number)), SarsplatError, words) for number, words in REASONS.items()),
        (KeyboardInterrupt("stopped"), KeyboardInterrupt, "stopped"),
    ],
)
def test_errors_keep_the_old_file_and_those_of_the_system_are_one_sentence(tmp_path, monkeypatch, error, raised, words):
    write_bytes(tmp_path / "a", b"old")
    monkeypatch.setattr(os, "fsync", Mock(side_effect=error))
    with pytest.raises(raised, match=words):
        write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder in which even root can write nothing")
def test_what_cannot_be_written_is_known_before_the_work(tmp_path):
    refuse_unwritable(tmp_path / "to" / "come")
    assert names(tmp_path) == []
    with pytest.raises(SarsplatError, match=r"cannot write /proc/self/"):  # whose permissions promise it to root
        refuse_unwritable(Path("/proc/self/a"))


def test_json_round_trip_and_refusals(tmp_path):
    path = tmp_path / "a.json"
    value = {"φ": [1, 2.5, None, True], "nested": {"x": "ü"}}
    write_json(path, value)
    assert read_json(path, Any) == value
    for bad in (float("nan"), float("inf"), object(), {1, 2}):
        with pytest.raises(SarsplatError, match="cannot be written as JSON"):
            write_json(path, bad)
    assert read_json(path, Any) == value
