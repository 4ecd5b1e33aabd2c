"""Folders that are whole or absent, written by one process at a time."""

from pathlib import Path

import pytest

from programs import elsewhere
from sarsplat.data.folders import new_folder, only_writer
from sarsplat.errors import SarsplatError

DATASET, RUN = "dataset.json", "config.json"


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


def test_what_a_killed_process_left_is_cleared_or_put_back(tmp_path):
    out, left = tmp_path / "out", tmp_path / ".out.sarsplat-new"
    make(left, "half")
    make(tmp_path, ".out.sarsplat-old/config.json")
    with pytest.raises(SarsplatError, match="exists"), new_folder(out, False, marker=RUN):
        pass  # killed between two renames: the old folder is back
    assert names(out) == [RUN]
    make(left, "half")
    make(tmp_path, ".out.sarsplat-old/config.json")
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


def test_the_only_writer_clears_what_an_overwriting_killed_one_left_beside(tmp_path):
    make(tmp_path, "out/config.json", ".out.sarsplat-new/config.json", ".out.sarsplat-old/config.json")
    (tmp_path / ".out.sarsplat-lock").touch()
    with only_writer(tmp_path / "out"):
        assert names(tmp_path) == [".out.sarsplat-lock", "out"]
    assert names(tmp_path) == ["out"]


def test_files_in_the_way(tmp_path):
    make(tmp_path, "file")
    (tmp_path / "loop").symlink_to("loop")
    for path in (tmp_path / "file" / "out", tmp_path / "file", tmp_path / "loop"):
        with pytest.raises(SarsplatError, match=r"^cannot write "), new_folder(path, True, marker=RUN):
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
