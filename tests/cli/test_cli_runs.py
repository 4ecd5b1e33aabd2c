"""Commands of runs: `sarsplat chips` and `sarsplat view`, and files of Gaussians of other programs."""

import csv
import json
import os
import re
import signal
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from made import dataset_of, small_dataset, upright
from made_runs import made_up
from sarsplat import ImageGrid, SarsplatError, View, read_points_ply, write_dataset, write_gaussians_ply
from sarsplat.cli import main
from sarsplat.gaussians import Gaussians
from sarsplat.importers.pictures import read_pixels
from sarsplat.samples import write
from sarsplat.samples.write import Made

Command = Callable[[str], str]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("runs")
    return " ".join(str(made_up(name, folder / name).folder) for name in ("box", "cone"))


def test_chips_in_folders_of_classes(runs: str, said: Command, refused: Command, tmp_path: Path) -> None:
    out = tmp_path / "set"
    text = said(f"chips {runs} --out {out} --count 3 --grazing 14.5:15.5 --crop 24")
    assert "6 chips of 2 classes, 24 × 24 pixels" in " ".join(text.split())
    with (out / "labels.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == ["box", "cone"] * 3
    assert all(14.5 <= float(row["grazing_deg"]) <= 15.5 for row in rows)
    for row in rows:
        assert read_pixels(out / row["path"]).shape == (24, 24)
    said(f"import folder {out} --class box --out {tmp_path / 'back'}")
    header = json.loads((out / "chips.json").read_text())
    for change, told in (({"count": -1}, "count is -1: expected"), ({"schema": None}, "its schema is None")):
        (out / "chips.json").write_text(json.dumps(header | change))
        with pytest.raises(SarsplatError, match=told):
            Made.read(out)


def test_azimuths_and_shards(runs: str, said: Command, tmp_path: Path) -> None:
    said(f"chips {runs} --out {tmp_path / 'set'} --azimuth 0:360:120 --shard 4 --format png")
    assert sorted(path.name for path in (tmp_path / "set").glob("*.tar")) == ["chips-000000.tar", "chips-000001.tar"]
    with (tmp_path / "set" / "labels.csv").open(newline="") as file:
        assert [float(row["azimuth_deg"]) for row in csv.DictReader(file)] == [0, 0, 120, 120, 240, 240]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--grazing 20:10", "grazing 20:10 goes down"),
        ("--grazing 1:2:3", "--grazing '1:2:3' is not 1 or 2 numbers; write it as 14.5:17.5"),
        ("--crop 64", "crop is 64, but the images of the runs have 32 × 36 pixels"),
        ("--scale calibrated", "choose npy"),
        ("--ground nowhere.png", "nowhere.png"),
        ("--seed -1", "seed -1 must be at least 0"),
    ],
)
def test_what_is_refused_leaves_nothing(runs: str, refused: Command, tmp_path: Path, options: str, words: str) -> None:
    assert words in refused(f"chips {runs} --out {tmp_path / 'set'} {options}")
    assert not list(tmp_path.iterdir())


def test_stopped_it_says_how_to_go_on(runs, said, refused, tmp_path, capsys, monkeypatch):
    out = tmp_path / "set"

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(write, "_table", stop)
        assert main(f"chips {runs} --out {out} --count 1".split()) == 128 + signal.SIGINT
    assert "the same command goes on from there" in capsys.readouterr().err
    assert not out.exists()
    other = refused(f"chips {runs} --out {out} --count 2")
    assert "differs in count (1, not 2); go on with it by the command that began it" in other
    assert "or pass --overwrite to begin anew" in other
    said(f"chips {runs} --out {out} --count 1")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert "already exists" in refused(f"chips {runs} --out {out}")
    (out / "chips.json").unlink()
    assert "contains no chips.json, so it will not be replaced" in refused(f"chips {runs} --out {out} --overwrite")


# ---- files of Gaussians of other programs ----------------------------------------------------------------------------
COUNT = 60


def scene(moved_m: Sequence[float] = (0, 0, 0), last_m: Sequence[float] | None = None) -> Gaussians:
    """Gaussians around a place; the last one may be somewhere else."""
    places = np.random.default_rng(0).uniform(-1, 1, (COUNT, 3)) * (2, 1, 0.5) + (0, 0, 0.5)
    means = torch.from_numpy(places).float() + torch.tensor(moved_m)
    if last_m is not None:
        means[-1] = torch.tensor(last_m)
    return upright(means, 0.2, 2.0)


def rendered(path: Path, *words: str) -> np.ndarray:
    out = path.with_suffix(".tif")
    command = ["render", str(path), "--azimuth", "30", "--grazing", "40", "--out", str(out), "--overwrite", *words]
    assert main(command) == 0
    return tifffile.imread(out)


def test_stray_gaussians_neither_set_the_pixels_nor_go_unsaid(tmp_path, said, capsys):
    """One is far, the other huge."""
    whole = scene(last_m=(1e4, 0, 0))
    whole.scales[-2] = torch.e**30
    write_gaussians_ply(tmp_path / "a.ply", whole)
    write_gaussians_ply(tmp_path / "b.ply", whole[:-2])
    image = rendered(tmp_path / "a.ply")
    told = capsys.readouterr().err
    assert "2 of 60 Gaussians lie apart or are far larger than all others: up to " in told
    assert "% of the power without shadows; they are left out" in told
    np.testing.assert_array_equal(image, rendered(tmp_path / "b.ply"))
    said(f"export {tmp_path}/a.ply {tmp_path}/points.ply --format points")
    assert np.abs(read_points_ply(tmp_path / "points.ply")[0]).max() < 5
    assert "apart          2 of 60 Gaussians" in said(f"info {tmp_path}/a.ply")


def test_whoever_gives_pixels_and_spacing_sees_what_lies_apart(tmp_path, said):
    write_gaussians_ply(tmp_path / "a.ply", scene(last_m=(100, 0, 0)))
    image = rendered(tmp_path / "a.ply", "--pixels", "256", "256", "--spacing", "1", "--resolution", "1")
    rows, columns = np.nonzero(image > 1e-3 * image.max())
    assert np.hypot(rows - 127.5, columns - 127.5).max() > 60
    said(f"export {tmp_path}/a.ply {tmp_path}/all.ply")
    assert b"element vertex 60\n" in (tmp_path / "all.ply").read_bytes()  # Gaussians are exported as they are


def test_far_scenes_are_brought_back_whatever_lies_at_the_origin(tmp_path, said):
    write_gaussians_ply(tmp_path / "a.ply", scene((1e4, 2e4, 300), (0, 0, 0)))
    write_gaussians_ply(tmp_path / "b.ply", scene()[:-1])
    image, near = rendered(tmp_path / "a.ply"), rendered(tmp_path / "b.ply")
    assert image.sum() == pytest.approx(near.sum(), rel=0.05)
    assert "far from the origin; images are made after (" in said(f"info {tmp_path}/a.ply")


def test_splat_files_are_described_rendered_and_exported(tmp_path, said):
    write_gaussians_ply(tmp_path / "a.ply", scene())
    for source, made in (("a.ply", "a.splat"), ("a.splat", "back.ply")):
        said(f"export {tmp_path}/{source} {tmp_path}/{made}")
        assert "60 Gaussians" in said(f"info {tmp_path}/{made}")
    assert rendered(tmp_path / "a.splat").max() > 0


def test_a_mesh_of_sparse_gaussians_is_not_told_to_train_longer(tmp_path, refused):
    write_gaussians_ply(tmp_path / "a.ply", upright(scene().means, 0.2, 0.01))
    told = refused(f"export {tmp_path}/a.ply {tmp_path}/a.glb")
    assert "train" not in told and "export the Gaussians themselves" in told


def test_gaussians_alone_are_not_scored_on_ground_without_a_word(tmp_path, warned):
    """Nothing scatters where they are not, so speckled ground is impossible to them: that was a dash in the table."""
    grid = ImageGrid(16, 16, (0.3, 0.3), (0.3, 0.3))
    power = np.random.default_rng(0).exponential(size=(8, 16, 16)).astype(np.float32)
    views = [(View(45.0 * k, 40.0), "test" if k % 4 == 0 else "train") for k in range(8)]
    write_dataset(tmp_path / "field", dataset_of(grid, views, power, ground=True, looks=1))
    write_gaussians_ply(tmp_path / "g.ply", scene())
    told = warned(f"evaluate {tmp_path}/g.ply --dataset {tmp_path}/field --no-points")
    assert "evaluate the run that it was exported from" in told


# ---- `sarsplat view`: where it is, how it ends, and what it says if it cannot be -------------------------------------
@pytest.fixture
def folder(tmp_path: Path) -> Path:
    pytest.importorskip("viser")
    write_dataset(tmp_path / "dataset", small_dataset())
    return tmp_path / "dataset"


@pytest.mark.skipif(os.name != "posix", reason="sends an interrupt")
def test_it_serves_until_ctrl_c_and_ends_with_one_sentence(folder, capsys, monkeypatch):
    before, told, pages = set(threading.enumerate()), [], []

    def look() -> None:
        while not (said := re.search(r"open (http\S+)", "".join(told))):
            told.append(capsys.readouterr().out)
            time.sleep(0.01)
        with urllib.request.urlopen(said[1]) as answer:
            pages.append(answer.read())
        os.kill(os.getpid(), signal.SIGINT)

    reader = threading.Thread(target=look)
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        reader.start()
        assert main(["view", str(folder), "--port", "0"]) == 0
    except KeyboardInterrupt:
        pytest.fail("it did not end by itself")
    finally:
        reader.join()
        signal.signal(signal.SIGINT, usual)
    (page,) = pages
    assert b"sarsplat view" in page
    out, err = capsys.readouterr()
    address = re.search(r"open (http\S+)", "".join(told))[1]
    assert out.split("\n", 1)[-1].replace("\n", "").strip() == f"ended; {address} no longer answers"
    assert err == ""
    assert not [one for one in set(threading.enumerate()) - before if not one.daemon]  # none keeps the process


def test_gaussians_far_from_the_origin_are_moved_there_and_it_says_by_how_much(tmp_path, said, monkeypatch):
    pytest.importorskip("viser")
    from sarsplat.viewer import Viewer

    far = upright(torch.tensor([[4.1e6, 0.9e6, 4.8e6], [4.1e6 + 4, 0.9e6, 4.8e6 + 2]]))
    write_gaussians_ply(tmp_path / "far.ply", far)

    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupt)
    told = " ".join(said(f"view {tmp_path}/far.ply --port 0").split())
    assert "open http://127.0.0.1:" in told
    assert "the Gaussians lie around (4100002, 900000, 4800000) m; that was subtracted" in told
    with pytest.raises(SarsplatError, match=r"around \(4100002, 900000, 4800000\) m, too far .*; subtract that"):
        Viewer(far)


def test_the_extra_is_named_if_it_is_missing(folder, refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    told = "error: this needs viser, which is not installed; install it with: pip install 'sarsplat[view]'\n"
    assert refused(f"view {folder}") == told
