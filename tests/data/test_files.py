"""Whole or absent: files, folders, JSON."""

import errno
import os
from pathlib import Path

import pytest

from sarsplat.data.files import new_folder, read_json, write_bytes, write_json
from sarsplat.errors import SarsplatError


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_write_bytes_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.bin"
    write_bytes(path, b"one")
    write_bytes(path, b"two")
    assert path.read_bytes() == b"two"
    assert names(tmp_path) == ["a.bin"]


def test_full_disk_keeps_the_old_file_and_says_so(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    write_bytes(path, b"old")
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(SarsplatError, match="the disk is full"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize(
    ("number", "words"), [(errno.EROFS, "read-only"), (errno.EACCES, "permission"), (errno.EIO, "check the path and")]
)
def test_os_errors_become_one_sentence(tmp_path, monkeypatch, number, words):
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(SarsplatError, match=words):
        write_bytes(tmp_path / "a", b"")
    with pytest.raises(SarsplatError, match=words), new_folder(tmp_path / "b", False):
        pass
    assert names(tmp_path) == []


def test_missing_folder_and_file_in_the_way(tmp_path):
    with pytest.raises(SarsplatError, match="does not exist"):
        write_bytes(tmp_path / "no" / "a", b"")
    (tmp_path / "file").write_text("")
    with pytest.raises(SarsplatError, match="is a file, not a folder"), new_folder(tmp_path / "file" / "out", False):
        pass
    with pytest.raises(SarsplatError, match="is a file, not a folder"), new_folder(tmp_path / "file", True):
        pass


def test_json_round_trip_and_refusals(tmp_path):
    path = tmp_path / "a.json"
    value = {"φ": [1, 2.5, None, True], "nested": {"x": "ü"}}
    write_json(path, value)
    assert read_json(path) == value
    for bad in (float("nan"), float("inf"), object(), {1, 2}):
        with pytest.raises(SarsplatError, match="cannot be written as JSON"):
            write_json(path, bad)
    assert read_json(path) == value


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"{", "not valid JSON"),
        (b"", "not valid JSON"),
        (b"\xff\xfe", "not valid JSON"),
        (b'{"a": NaN}', "NaN"),
        (b'{"a": -Infinity}', "Infinity"),
        (b'{"a": 1e999}', "too large"),
        (b'{"a": ' + b"9" * 5000 + b"}", "not valid JSON"),
        (b"[" * 200_000, "nested too deeply"),
    ],
)
def test_bad_json(tmp_path, content, words):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(SarsplatError, match=words) as caught:
        read_json(path)
    assert str(path) in str(caught.value)


def test_missing_json_and_folder_for_json(tmp_path):
    with pytest.raises(SarsplatError, match="does not exist"):
        read_json(tmp_path / "a.json")
    with pytest.raises(SarsplatError, match="is a folder"):
        read_json(tmp_path)


def test_new_folder_appears_whole_with_usual_permissions(tmp_path):
    out = tmp_path / "deep" / "out"
    with new_folder(out, False) as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("a")
        assert not out.exists()
    assert (out / "sub" / "a").read_text() == "a"
    assert names(out.parent) == ["out"]
    plain = tmp_path / "plain"
    plain.mkdir()
    assert out.stat().st_mode == plain.stat().st_mode


def test_existing_folder_needs_overwrite_but_an_empty_one_does_not(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with new_folder(out, False) as folder:
        (folder / "one").write_text("")
    with pytest.raises(SarsplatError, match=r"exists; give another name or --overwrite"), new_folder(out, False):
        pytest.fail("must not get here")
    with new_folder(out, True) as folder:
        (folder / "two").write_text("")
    assert names(out) == ["two"]
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_error_keeps_the_old_folder(tmp_path, error):
    out = tmp_path / "out"
    out.mkdir()
    (out / "old").write_text("")
    with pytest.raises(error), new_folder(out, True) as folder:
        (folder / "half").write_text("")
        raise error
    assert names(out) == ["old"]
    assert names(tmp_path) == ["out"]


def test_a_failed_swap_puts_the_old_folder_back(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "old").write_text("")
    rename = Path.replace

    def fail_for_the_new_one(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", fail_for_the_new_one)
    with pytest.raises(KeyboardInterrupt), new_folder(out, True) as folder:
        (folder / "new").write_text("")
    assert names(out) == ["old"]
    assert names(tmp_path) == ["out"]


def test_overwrite_spares_the_work_place_and_folders_of_others(tmp_path, monkeypatch):
    out = tmp_path / "out"
    (out / "inside").mkdir(parents=True)
    (out / "thesis.tex").write_text("")
    with pytest.raises(SarsplatError, match=r"holds no dataset\.json"), new_folder(out, True, marker="dataset.json"):
        pass
    monkeypatch.chdir(out / "inside")
    for path in (Path(), Path(".."), out):
        with pytest.raises(SarsplatError, match="never replaced"), new_folder(path, True):
            pass
    assert (out / "thesis.tex").exists()
