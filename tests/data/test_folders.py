"""Folders that are whole or absent, replaced in one step, by one process at a time."""

import errno
import os
from pathlib import Path

import pytest

from elsewhere import elsewhere
from sarsplat.data import folders, write_bytes
from sarsplat.data.folders import new_folder, only_writer, refuse_existing
from sarsplat.errors import SarsplatError

DATASET, RUN, SHEET = "dataset.json", "config.json", "contact-sheet.png"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def make(out: Path, *files: str) -> None:
    for file in files:
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        (out / file).write_text(file)


def test_it_appears_whole_with_usual_permissions(tmp_path):
    out = tmp_path / "deep" / "out"
    with new_folder(out, False, marker=DATASET) as folder:
        make(folder, "sub/a")
        assert not out.exists()
    assert (out / "sub" / "a").read_text() == "sub/a"
    assert names(out.parent) == ["out"]
    plain = tmp_path / "plain"
    plain.mkdir()
    assert out.stat().st_mode == plain.stat().st_mode


def test_existing_folder_needs_overwrite_but_an_empty_one_does_not(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with new_folder(out, False, marker=DATASET) as folder:
        make(folder, DATASET, "truth.ply")
    with pytest.raises(SarsplatError, match="exists; choose another name"), new_folder(out, False, marker=DATASET):
        pytest.fail("must not get here")
    with new_folder(out, True, marker=DATASET) as folder:
        make(folder, DATASET)
    assert names(out) == [DATASET]
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_error_keeps_the_old_folder(tmp_path, error):
    out = tmp_path / "out"
    make(out, RUN)
    with pytest.raises(error), new_folder(out, True, marker=RUN) as folder:
        make(folder, "half")
        raise error
    assert names(out) == [RUN]
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("exchange", [True, False])
def test_the_output_is_there_at_every_moment_of_the_swap(tmp_path, monkeypatch, exchange):
    """In one step where the file system can; in two, a failure between them puts the old folder back."""
    out = tmp_path / "out"
    make(out, RUN)
    rename, seen = Path.replace, []

    def watched(self: Path, target: Path) -> Path:
        seen.append(out.exists())
        if self.name == "new":
            raise KeyboardInterrupt
        return rename(self, target)

    if not exchange:
        monkeypatch.setattr(folders, "_exchange", lambda one, other: False)
        monkeypatch.setattr(Path, "replace", watched)
        with pytest.raises(KeyboardInterrupt), new_folder(out, True, marker=RUN) as folder:
            make(folder, RUN, "points.ply")
        assert seen == [True, False, False]
        assert names(out) == [RUN]
        return
    make(tmp_path / "other", "x")
    if not folders._exchange(out, tmp_path / "other"):
        pytest.skip("this file system cannot exchange two names")
    folders._exchange(out, tmp_path / "other")
    monkeypatch.setattr(Path, "replace", watched)
    with new_folder(out, True, marker=RUN) as folder:
        make(folder, RUN, "points.ply")
    assert seen == []
    assert names(out) == [RUN, "points.ply"]


def test_an_exchange_that_fails_for_another_reason_says_why(tmp_path):
    make(tmp_path, "a")
    with pytest.raises(OSError, match="No such file"):
        folders._exchange(tmp_path / "a", tmp_path / "nothing")


def test_what_a_killed_process_left_is_cleared_or_put_back(tmp_path):
    out, left = tmp_path / "out", tmp_path / ".out.tmpdir"
    make(left, "new/half", "old/config.json")
    with pytest.raises(SarsplatError, match="exists"), new_folder(out, False, marker=RUN):
        pass  # killed between two renames: the old folder is back
    assert names(out) == [RUN]
    make(left, "new/half", "old/config.json")
    with new_folder(out, True, marker=RUN) as folder:
        assert names(folder) == []
        make(folder, RUN, "points.ply")
    assert names(out) == [RUN, "points.ply"]
    assert names(tmp_path) == ["out"]


def test_what_another_process_is_using_is_left_alone(tmp_path):
    out = tmp_path / "out"
    with new_folder(out, False, marker=RUN) as folder:
        make(folder, RUN)
        for another in (new_folder(out, False, marker=RUN), only_writer(out)):
            with pytest.raises(SarsplatError, match="out is in use by another"), elsewhere(another):
                pass
    replacing = new_folder(out, True, marker=RUN)
    with elsewhere(only_writer(out)), pytest.raises(SarsplatError, match="out is in use"), replacing:
        pytest.fail("must not get here")
    assert names(out) == [RUN]
    assert names(tmp_path) == ["out"]


def test_who_writes_a_folder_may_replace_it_and_go_on(tmp_path):
    out = tmp_path / "deep" / "out"
    with only_writer(out):
        with new_folder(out, False, marker=RUN) as folder:
            make(folder, RUN)
        with pytest.raises(SarsplatError, match="in use"), elsewhere(only_writer(out)):
            pass
        assert names(out) == [RUN]
    with elsewhere(only_writer(out)):
        pass
    assert names(out.parent) == ["out"]


def test_the_only_writer_removes_what_a_killed_one_left(tmp_path):
    left = (".points.ply.tmp", "checkpoints/.00000007.safetensors.tmp", "report/.index.html.lock")
    make(tmp_path, "config.json", *left)
    with only_writer(tmp_path):
        assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["config.json"]


def test_the_only_writer_clears_what_an_overwriting_killed_one_left_beside(tmp_path):
    make(tmp_path, "out/config.json", ".out.tmpdir/new/config.json")
    (tmp_path / ".out.lock").touch()
    with only_writer(tmp_path / "out"):
        assert names(tmp_path) == [".out.lock", "out"]
    assert names(tmp_path) == ["out"]


def test_the_only_writer_spares_what_is_not_of_a_run(tmp_path):
    out, others = tmp_path / "out", [".notes.tmp", "mine/.keep.tmp", ".dir.tmp/inside", "checkpoints/.best.tmp"]
    make(out, "config.json", *others)
    (out / "report").mkdir()
    (out / "report" / ".page.png.tmp").symlink_to(tmp_path)
    make(tmp_path, ".out.tmpdir/mine")
    with only_writer(out):
        assert all((out / file).is_file() for file in others)
        assert (out / "report" / ".page.png.tmp").is_symlink()
    assert (tmp_path / ".out.tmpdir" / "mine").is_file()


@pytest.mark.parametrize("kind", ["link", "folder", "file", "link inside"])
def test_a_temporary_folder_of_others_is_left_alone(tmp_path, kind):
    out, temporary, outside = tmp_path / "out", tmp_path / ".out.tmpdir", tmp_path / "outside"
    make(outside, "new/file")
    if kind == "link":
        temporary.symlink_to(outside)
    elif kind == "folder":
        make(temporary, "mine/file", "new/file")
    elif kind == "file":
        temporary.write_text("")
    else:
        temporary.mkdir()
        (temporary / "old").symlink_to(outside)
    before = sorted(tmp_path.rglob("*"))
    told = r"\.out\.tmpdir (is in the way|holds (mine|old), which sarsplat did not create)"
    with pytest.raises(SarsplatError, match=told):
        refuse_existing(out, False, marker=RUN)
    with pytest.raises(SarsplatError, match=told), new_folder(out, False, marker=RUN):
        pass
    assert sorted(tmp_path.rglob("*")) == before
    make(out, RUN)
    with only_writer(out):
        assert sorted({*tmp_path.rglob("*")} - {out, out / RUN, tmp_path / ".out.lock"}) == before


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC])
def test_os_errors_become_one_sentence(tmp_path, monkeypatch, number):
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(SarsplatError, match=r"read-only|full"), new_folder(tmp_path / "b", False, marker=RUN):
        pass
    assert names(tmp_path) == []


def test_it_is_flushed_as_a_whole_and_not_file_by_file(tmp_path, monkeypatch):
    flushed, whole = [], []
    monkeypatch.setattr(os, "fsync", flushed.append)
    monkeypatch.setattr("sarsplat.data.folders._flush_whole_disk", lambda folder: whole.append(folder) or True)
    with new_folder(tmp_path / "a", False, marker=RUN) as folder:
        for name in ("one", "two"):
            write_bytes(folder / name, b"content")
        assert names(folder) == ["one", "two"]
    assert whole == [folder]
    assert len(flushed) == 1  # the folder in which it has appeared
    write_bytes(tmp_path / "a" / "one", b"other")
    assert len(flushed) == 3


def test_files_in_the_way(tmp_path):
    make(tmp_path, "file")
    (tmp_path / "loop").symlink_to("loop")
    for path in (tmp_path / "file" / "out", tmp_path / "file", tmp_path / "loop"):
        with pytest.raises(SarsplatError, match="is a file, not a folder"), new_folder(path, True, marker=RUN):
            pass


def test_overwrite_spares_the_work_place_and_folders_of_others(tmp_path, monkeypatch):
    out = tmp_path / "out"
    make(out, "inside/thesis.tex")
    with pytest.raises(SarsplatError, match=r"contains no dataset\.json"), new_folder(out, True, marker=DATASET):
        pass
    monkeypatch.chdir(out / "inside")
    for path in (Path(), Path(".."), out):
        with pytest.raises(SarsplatError, match="never replaced"), new_folder(path, True, marker=DATASET):
            pass
    assert (out / "inside" / "thesis.tex").exists()


@pytest.mark.parametrize(
    ("marker", "ours", "foreign"),
    [
        (DATASET, ["truth.ply", "images/000.tif"], "run/config.json"),
        (DATASET, ["images/.000.tif.tmp"], "images/deeper/000.tif"),
        (RUN, ["about.json", "metrics.jsonl", "gaussians.ply", "mesh.ply"], "other.ply"),
        (RUN, ["metrics.jsonl", "checkpoints/00000500.safetensors", "report/views.png"], "notes.txt"),
        (RUN, ["tiles/0/config.json", "tiles/0/metrics.jsonl", "tiles/11/checkpoints/00000005.safetensors"], "tiles/a"),
        (
            RUN,
            [".points.ply.tmp", ".points.ply.lock", "report/index.html"],
            "checkpoints/best.safetensors",
        ),
        (SHEET, ["az000_gr45.tif", "az352.5_gr07.png"], "holiday.png"),
    ],
)
def test_a_folder_is_replaced_only_if_all_in_it_is_ours(tmp_path, marker, ours, foreign):
    out = tmp_path / "out"
    make(out, marker, *ours, foreign)
    with pytest.raises(SarsplatError, match=f"also holds {foreign}"), new_folder(out, True, marker=marker):
        pass
    (out / foreign).unlink()
    (out / "link").symlink_to(tmp_path)
    with pytest.raises(SarsplatError, match="also holds link"), new_folder(out, True, marker=marker):
        pass
    (out / "link").unlink()
    with new_folder(out, True, marker=marker) as folder:
        make(folder, marker)
    assert names(out) == [marker]
