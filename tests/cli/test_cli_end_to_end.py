"""The whole way on the command line, on a target small enough to take seconds."""

import errno
import json
import os
import re
import shutil
import signal
import warnings
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from made import FEW_POINTS
from programs import elsewhere
from sarsplat import Config, Trainer, read_points_ply, scenes
from sarsplat.cli import main
from sarsplat.data.folders import only_writer
from sarsplat.exports import FORMATS
from sarsplat.runs import Run, own_gaussians
from sarsplat.surface import first_returns, normals


@pytest.fixture
def quick_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few rays for the points of Gaussians in a file, and few images of them."""
    monkeypatch.setattr(own_gaussians, "Config", partial(Config, points=FEW_POINTS))
    monkeypatch.setattr(own_gaussians, "_AROUND", own_gaussians._AROUND[::2])
    monkeypatch.setattr(own_gaussians, "_PIXELS", 64)


@pytest.fixture(autouse=True)
def here(there: None) -> None:
    """All of this is done in the workshop."""


def test_evaluate_writes_every_score_and_refreshes_the_report() -> None:
    metrics = json.loads(Path("run/metrics.json").read_text())
    psnr_db = metrics["images"]["test"]["psnr_db"]
    assert psnr_db > 10
    assert metrics["images"]["test"]["lpips"] is None
    assert metrics["points"]["visible"]["cd_m"] > 0
    assert metrics["baselines"] is None
    assert metrics["seed"] == 0
    assert f"{psnr_db:.2f}" in Path("run/report/index.html").read_text()


def test_export_and_info(tmp_path: Path, said, refused) -> None:
    for kind in ("gaussians", "points", "mesh"):
        said(f"export run {tmp_path}/{kind}.ply --format {kind}")
    for name in ("plain.ply", "mesh.glb", "mesh.obj"):
        said(f"export run {tmp_path}/{name}")
    count = Run.load("run").history[-1].gaussians
    assert (tmp_path / "plain.ply").read_bytes() == (tmp_path / "gaussians.ply").read_bytes()
    points, columns = read_points_ply(tmp_path / "points.ply")
    assert list(columns) == ["nx", "ny", "nz", "gamma0"]
    np.testing.assert_allclose(sum(columns[name] ** 2 for name in ("nx", "ny", "nz")), 1, atol=1e-5)
    assert (columns["gamma0"] >= 0).all() and columns["gamma0"].max() > 0
    np.testing.assert_array_equal(points, read_points_ply("run/points.ply")[0])
    refused(f"export run {tmp_path}/points.ply --format points")
    expected = {
        "run": ": a run",
        "dataset": "8 images",
        "dataset/truth.ply": "a mesh",
        "box.obj": "a mesh",
        tmp_path / "gaussians.ply": f"{count} Gaussians",
        **{tmp_path / f"mesh.{kind}": "a mesh" for kind in ("ply", "glb", "obj")},
        tmp_path / "points.ply": f"{len(points):,};",
    }
    for path, text in expected.items():
        assert text in said(f"info {path}").replace("\n", " ")


def test_gaussians_in_a_file_are_taken_like_a_run(tmp_path: Path, quick_own, said, refused) -> None:
    gaussians = tmp_path / "g.ply"
    said(f"export run {gaussians}")
    for source, name in (("run", "a.splat"), (gaussians, "b.splat")):
        said(f"export {source} {tmp_path}/{name}")
    assert (tmp_path / "a.splat").read_bytes() == (tmp_path / "b.splat").read_bytes()
    assert "0 dB is the brightest pixel from all sides" in said(
        f"render {gaussians} --azimuth 0 --grazing 45 --pixels 20 30 --spacing 0.3 --out {tmp_path}/g.png"
    )
    with Image.open(tmp_path / "g.png") as picture:
        assert picture.size == (30, 20)
    assert "is the file that is exported" in refused(f"export {gaussians} {gaussians} --overwrite")
    assert "give --dataset DIR, or --mesh FILE" in refused(f"evaluate {gaussians}")
    told = said(f"evaluate {gaussians} --dataset dataset")
    psnr_db = json.loads(Path("run/metrics.json").read_text())["images"]["test"]["psnr_db"]
    assert f"{psnr_db:.2f}" in told
    assert "CD m" in said(f"evaluate {gaussians} --mesh box.obj")
    assert {path.name for path in tmp_path.iterdir()} == {"a.splat", "b.splat", "g.ply", "g.png"}


def test_ctrl_c_says_how_to_continue(tmp_path: Path, monkeypatch, ended, said) -> None:
    step, calls = Trainer.step, []

    def interrupted(trainer: Trainer) -> object:
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)  # the step is finished first
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", interrupted)
    _, complaint = ended(f"reconstruct dataset --out {tmp_path}/run --iterations 9", 130)
    assert "--resume" in complaint
    assert "Traceback" not in complaint
    monkeypatch.setattr(Trainer, "step", step)
    assert "3 of 9" in said(f"info {tmp_path}/run")


@pytest.mark.parametrize(
    ("module", "name", "number", "by"),
    [
        (first_returns, "render", signal.SIGTERM, "terminated"),
        (normals, "neighbours_of", signal.SIGINT, "stopped by Ctrl-C"),
    ],
)
def test_one_signal_ends_the_extraction_and_the_run_resumes(
    tmp_path: Path, module: ModuleType, name: str, number: int, by: str, monkeypatch, ended, said
) -> None:
    out = tmp_path / "run"
    few = "--iterations 4 --points.voxel 0.3 --points.rays-per-pixel 2"
    words = f"reconstruct dataset {few} --out {out}"
    usual = getattr(module, name)

    def signalled(*arguments: Any, **options: Any) -> Any:
        os.kill(os.getpid(), number)
        return usual(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(module, name, signalled)
        _, message = ended(words, 128 + number)
    assert f"error: {by}; {out} keeps the progress so far; continue with `sarsplat reconstruct" in message
    assert "Traceback" not in message
    assert Run.load(out).iteration == 4
    assert not (out / "points.ply").exists()
    assert " s of training; default, seed 0)" in said(f"{words} --resume")
    assert (out / "points.ply").is_file()


def test_a_run_that_goes_on_is_told_as_it_is(run: Path, monkeypatch, said) -> None:
    def interrupted(_: Trainer) -> None:
        raise KeyboardInterrupt

    assert "4 of 4" in said(f"info {run}")
    monkeypatch.setattr(Trainer, "step", interrupted)
    assert main(f"reconstruct dataset --out {run} --resume --iterations 9".split()) == 130
    assert "4 of 9" in said(f"info {run}")
    assert not {"about.json", "points.ply"} & {path.name for path in run.iterdir()}


RECONSTRUCT = "reconstruct dataset --out run"


@pytest.mark.parametrize(
    "command", ["evaluate run", "report run", f"{RECONSTRUCT} --resume", f"{RECONSTRUCT} --overwrite"]
)
def test_a_second_process_is_refused(workshop: Path, command: str, refused) -> None:
    before = {path: path.stat().st_mtime_ns for path in (workshop / "run").rglob("*")}
    with elsewhere(only_writer(workshop / "run")):
        assert "in use by another process; wait" in refused(command)
    assert {path: path.stat().st_mtime_ns for path in (workshop / "run").rglob("*")} == before


def test_export_replaces_nothing_but_its_like(workshop: Path, tmp_path: Path, said, refused) -> None:
    export = "export run --overwrite"
    before = Path("run/gaussians.ply").read_bytes()
    assert "is inside the run" in refused(f"{export} run/gaussians.ply")
    (tmp_path / "inside").symlink_to(workshop / "run")
    assert "is inside the run" in refused(f"{export} {tmp_path}/inside/new.ply")
    assert Path("run/gaussians.ply").read_bytes() == before
    for ending in FORMATS:
        (tmp_path / f"thesis.{ending}").write_text("\\documentclass")
        assert f"not a .{ending} file as exported" in refused(f"{export} {tmp_path}/thesis.{ending}")
        for _ in range(2 if ending != "geojson" else 0):  # which needs a place on earth
            said(f"{export} {tmp_path}/new.{ending}")
    (tmp_path / "null.ply").symlink_to("/dev/null")
    assert "device" in refused(f"{export} {tmp_path}/null.ply")
    assert Path("/dev/null").is_char_device()
    (tmp_path / "folder.ply").mkdir()
    assert "folder" in refused(f"{export} {tmp_path}/folder.ply")


@pytest.mark.parametrize("out", [".", "/", "pictures", "run"])
@pytest.mark.parametrize("command", ["simulate --mesh box.obj", "render run"])
def test_overwrite_is_refused_before_the_work(out: str, command: str, monkeypatch, refused) -> None:
    def work(*_: object, **__: object) -> None:
        pytest.fail("must not get here")

    monkeypatch.setattr(scenes, "load_mesh", work)
    monkeypatch.setattr(Run, "render", work)
    Path("pictures").mkdir(exist_ok=True)
    Path("pictures/holiday.png").write_text("")
    assert "choose another name" in refused(f"{command} --azimuth 0 --grazing 45 --overwrite --out {out}")


@pytest.mark.parametrize("command", ["report", "evaluate"])
def test_a_report_is_not_written_through_a_link(run: Path, tmp_path: Path, command: str, refused) -> None:
    outside = tmp_path / "outside"
    shutil.rmtree(run / "report")
    (run / "metrics.json").unlink()
    outside.mkdir()
    (run / "report").symlink_to(outside)
    assert "report is a link" in refused([command, str(run)])
    assert list(outside.iterdir()) == []
    assert not (run / "metrics.json").exists()


WRITING = (
    "simulate --mesh box.obj --azimuth 0 --grazing 45 --pixels 32 --out new",
    "reconstruct dataset --iterations 2 --out new",
    "reconstruct dataset --iterations 2 --overwrite --out run",
    "evaluate run",
    "report run",
    "render run --azimuth 5 --grazing 45 --out new",
    "export run new.ply",
    "export run new.glb",
)


@pytest.mark.parametrize("command", WRITING)
def test_a_full_disk_changes_nothing(workshop: Path, command: str, monkeypatch, refused) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def everything() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in workshop.rglob("*") if path.is_file()}

    before = everything()
    monkeypatch.setattr(Path, "replace", refuse)
    assert "the disk is full; free some space" in refused(command)
    assert everything() == before


def test_a_folder_of_rendered_images(tmp_path: Path, said, refused) -> None:
    out = tmp_path / "images.v2"  # a folder may have a dot
    command = f"render run --azimuth 0:90:45 --incidence 60 --out {out}"
    told = said(command)
    names = [f"az{azimuth}_gr30.{ending}" for azimuth in ("000", "045") for ending in ("png", "tif")]
    assert sorted(path.name for path in out.iterdir()) == [*names, "contact-sheet.png"]
    assert "40 dB" in told
    assert f"wrote {out}: 2 images" in told
    assert "already exists" in refused(command)
    said(f"{command} --overwrite")


def test_evaluating_images_alone_keeps_the_points_and_says_so(run, tmp_path, unfinished, ended, warned) -> None:
    before = json.loads((run / "metrics.json").read_text())
    alone = f"evaluate {run} --no-points --no-report"
    told, complaints = ended(alone, 0)
    assert complaints == ""
    assert "points and mesh: their scores are those of the earlier evaluation" in told
    assert re.search(r"^time: \d+\.\d s", told, re.MULTILINE)
    assert json.loads((run / "metrics.json").read_text()) == before
    unfinished(run)
    (run / "metrics.json").unlink()
    told, complaints = ended(alone, 0)
    assert "earlier evaluation" not in told
    with warnings.catch_warnings(record=True):
        assert "4 of 6,000 iterations; its result so far is used" in warned(f"export {run} {tmp_path}/g.splat")
    assert f"{run} is unfinished, 4 of 6,000 iterations: the scores are provisional" in complaints


def test_doctor_knows_what_is_installed(said) -> None:
    told = said("doctor")
    assert re.search(r"cuda +(not usable: the CUDA engine needs|not usable: torch|\S.* by NVRTC \d)", told)
    assert "trimesh" in told
    assert "SARSPLAT_LPIPS_WEIGHTS" in told
    assert said("--version").startswith("sarsplat ")
