"""The whole way on the command line, on a target small enough to take seconds."""

import errno
import json
import os
import re
import shutil
import signal
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
import trimesh
from PIL import Image

from elsewhere import elsewhere
from sarsplat import scenes
from sarsplat.cli import main
from sarsplat.data import read_dataset, read_gaussians_ply, read_points_ply
from sarsplat.data.folders import only_writer
from sarsplat.reconstruction import Run
from scoring import few_samples


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a mesh, a dataset and an evaluated run."""
    folder = tmp_path_factory.mktemp("workshop")
    box = trimesh.creation.box(extents=(2.4, 1.2, 1.0))
    box.apply_translation((0, 0, 0.5))
    box.export(folder / "box.obj")
    simulate = ["simulate", "--mesh", str(folder / "box.obj"), "--out", str(folder / "dataset")]
    simulate += ["--azimuth", "0:360:90", "--grazing", "30", "60", "--test-azimuth", "0:360:45", "--pixels", "32"]
    assert main(simulate) == 0
    few = ["--iterations", "4", "--points.voxel", "0.3", "--points.rays-per-pixel", "2"]
    assert main(["reconstruct", str(folder / "dataset"), "--out", str(folder / "run"), *few]) == 0
    with few_samples():
        assert main(["evaluate", str(folder / "run")]) == 0
    return folder


def test_simulate_writes_the_views_that_were_asked_for(workshop: Path) -> None:
    dataset = read_dataset(workshop / "dataset")
    train = {(view.azimuth_deg, view.grazing_deg) for view in dataset.select("train").views}
    test = {(view.azimuth_deg, view.grazing_deg) for view in dataset.select("test").views}
    assert train == {(azimuth, grazing) for azimuth in (0, 90, 180, 270) for grazing in (30, 60)}
    assert test == {(azimuth, grazing) for azimuth in (45, 135, 225, 315) for grazing in (30, 60)}
    assert (dataset.grid.rows, dataset.grid.spacing_m) == (32, (0.3, 0.3))
    assert dataset.truth_mesh is not None
    assert dataset.source["kind"] == "raycast"
    assert dataset.target == "box.obj"
    assert dataset.source["law"] == {"floor": 0.1, "lobe": 0.9, "exponent": 2.0}
    assert dataset.protocol is None


def test_evaluate_writes_every_score(workshop: Path) -> None:
    metrics = json.loads((workshop / "run" / "metrics.json").read_text())
    assert metrics["images"]["test"]["psnr_db"] > 10
    assert metrics["images"]["test"]["lpips"] is None
    assert metrics["points"]["visible"]["cd_m"] > 0
    assert metrics["baselines"] is None
    assert metrics["seed"] == 0


def test_evaluate_refreshes_the_report(workshop: Path) -> None:
    page = (workshop / "run" / "report" / "index.html").read_text()
    psnr = json.loads((workshop / "run" / "metrics.json").read_text())["images"]["test"]["psnr_db"]
    assert f"{psnr:.2f}" in page


def test_render_sweep(workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "images"
    command = ["render", str(workshop / "run"), "--azimuth", "0:90:45", "--incidence", "45", "--out", str(out)]
    assert main(command) == 0
    assert {path.name for path in out.iterdir()} == {
        *("az000_gr45.tif", "az000_gr45.png", "az045_gr45.tif", "az045_gr45.png"),
        "contact-sheet.png",
    }
    power = tifffile.imread(out / "az045_gr45.tif")
    assert power.dtype == np.float32
    picture = np.asarray(Image.open(out / "az045_gr45.png"))
    peak = read_dataset(workshop / "dataset").images("train").max()
    expected = 255 * np.clip(1 + 10 * np.log10(np.maximum(power, 1e-30) / peak) / 40, 0, 1)
    np.testing.assert_allclose(picture, expected, atol=0.51)
    said = capsys.readouterr().out
    assert "40 dB" in said
    assert f"wrote {out}: 2 images" in said
    assert main(command) == 2
    assert main([*command, "--overwrite"]) == 0


def test_export_and_info(workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = str(workshop / "run")
    for kind in ("gaussians", "points", "mesh"):
        assert main(["export", run, str(tmp_path / f"{kind}.ply"), "--format", kind]) == 0
    for name in ("plain.ply", "mesh.glb", "mesh.obj"):
        assert main(["export", run, str(tmp_path / name)]) == 0
    count = Run.load(run).history[-1].gaussians
    assert len(read_gaussians_ply(tmp_path / "plain.ply")) == count
    assert (tmp_path / "plain.ply").read_bytes() == (tmp_path / "gaussians.ply").read_bytes()
    points, columns = read_points_ply(tmp_path / "points.ply")
    assert list(columns) == ["nx", "ny", "nz", "gamma0"]
    np.testing.assert_allclose(sum(columns[name] ** 2 for name in ("nx", "ny", "nz")), 1, atol=1e-5)
    assert (columns["gamma0"] >= 0).all() and columns["gamma0"].max() > 0
    np.testing.assert_array_equal(points, read_points_ply(workshop / "run" / "points.ply")[0])
    assert main(["export", run, str(tmp_path / "points.ply"), "--format", "points"]) == 2
    capsys.readouterr()
    expected = {
        run: ": a run",
        str(workshop / "dataset"): "8 images",
        str(workshop / "dataset" / "images" / "000.tif"): "a power image",
        str(workshop / "dataset" / "truth.ply"): "a mesh",
        str(workshop / "box.obj"): "a mesh",
        str(tmp_path / "gaussians.ply"): f"{count} Gaussians",
        **{str(tmp_path / f"mesh.{kind}"): "a mesh" for kind in ("ply", "glb", "obj")},
        str(tmp_path / "points.ply"): f"{len(points)};",
    }
    for path, text in expected.items():
        assert main(["info", path]) == 0
        assert text in capsys.readouterr().out.replace("\n", " ")


def test_resume_keeps_the_settings_of_the_run(
    workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, dataset = str(tmp_path / "run"), str(workshop / "dataset")
    flags = ["--iterations", "2", "--initialisation", "hemisphere", "--seed", "7"]
    assert main(["reconstruct", dataset, "--out", run, *flags]) == 0
    assert main(["reconstruct", dataset, "--out", run, "--resume"]) == 0
    assert "seed 7" in capsys.readouterr().out
    assert main(["reconstruct", dataset, "--out", run, "--resume", "--preset", "paper"]) == 2
    assert "was started with preset 'default'" in capsys.readouterr().err


def test_ctrl_c_says_how_to_go_on(
    workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sarsplat.reconstruction import Trainer

    step, calls = Trainer.step, []

    def interrupted(trainer: Trainer) -> object:
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)  # the step is finished first
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", interrupted)
    run = tmp_path / "run"
    assert main(["reconstruct", str(workshop / "dataset"), "--out", str(run), "--iterations", "9"]) == 130
    complaint = capsys.readouterr().err
    assert "--resume" in complaint
    assert "Traceback" not in complaint
    monkeypatch.undo()
    assert main(["info", str(run)]) == 0
    assert "3 of 9" in capsys.readouterr().out


def refusal(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What is said to a command that is refused: one sentence."""
    capsys.readouterr()
    assert main(command) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("error: ")
    assert complaint.count("\n") == 1
    return complaint


@pytest.mark.parametrize("command", ["evaluate RUN", "report RUN", "reconstruct DATASET --out RUN --resume"])
def test_a_second_process_is_refused(workshop: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    places = {"RUN": str(workshop / "run"), "DATASET": str(workshop / "dataset")}
    before = {path: path.stat().st_mtime_ns for path in (workshop / "run").rglob("*")}
    with elsewhere(only_writer(workshop / "run")):
        assert "in use by another process; wait" in refusal([places.get(w, w) for w in command.split()], capsys)
    assert {path: path.stat().st_mtime_ns for path in (workshop / "run").rglob("*")} == before


def test_export_replaces_nothing_but_its_like(
    workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export = ["export", str(workshop / "run"), "--overwrite"]
    own = workshop / "run" / "gaussians.ply"
    before = own.read_bytes()
    assert "is inside the run" in refusal([*export, str(own)], capsys)
    (tmp_path / "inside").symlink_to(workshop / "run")
    assert "is inside the run" in refusal([*export, str(tmp_path / "inside" / "new.ply")], capsys)
    assert own.read_bytes() == before
    for kind in ("ply", "glb", "obj", "splat", "las", "xyz", "npz"):
        (tmp_path / f"thesis.{kind}").write_text("\\documentclass")
        assert f"not a .{kind} file as exported" in refusal([*export, str(tmp_path / f"thesis.{kind}")], capsys)
    (tmp_path / "null.ply").symlink_to("/dev/null")
    assert "device" in refusal([*export, str(tmp_path / "null.ply")], capsys)
    assert Path("/dev/null").is_char_device()
    (tmp_path / "folder.ply").mkdir()
    assert "folder" in refusal([*export, str(tmp_path / "folder.ply")], capsys)
    for name in ("new.ply", "new.glb", "new.obj", "new.splat", "new.las", "new.xyz", "new.npz"):
        for _ in range(2):
            assert main([*export, str(tmp_path / name)]) == 0
    assert "not a valid name for points; choose one that ends in .las, .ply or .xyz" in refusal(
        [*export, str(tmp_path / "points.glb"), "--format", "points"], capsys
    )
    assert "not a valid name for a mesh; choose one that ends in .glb, .obj or .ply" in refusal(
        [*export, str(tmp_path / "mesh.stl"), "--format", "mesh"], capsys
    )


def test_overwrite_spares_what_is_not_ours(workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures = tmp_path / "pictures"
    render = ["render", str(workshop / "run"), "--azimuth", "5", "--grazing", "45", "--out", str(pictures)]
    assert main(render) == 0
    (pictures / "holiday.png").write_text("")
    assert "also holds holiday.png" in refusal([*render, "--overwrite"], capsys)
    shutil.copytree(workshop / "dataset", tmp_path / "dataset")
    shutil.copytree(workshop / "run", tmp_path / "dataset" / "run")
    simulate = ["simulate", "--target", "t72", "--azimuth", "0", "--grazing", "45", "--pixels", "32", "--overwrite"]
    assert "also holds run/" in refusal([*simulate, "--out", str(tmp_path / "dataset")], capsys)
    assert (tmp_path / "dataset" / "run" / "points.ply").exists()


@pytest.mark.parametrize("out", [".", "/", "pictures", "run"])
@pytest.mark.parametrize(
    "command", ["simulate --mesh box.obj --azimuth 0 --grazing 45", "render run --azimuth 0 --grazing 45"]
)
def test_overwrite_is_refused_before_the_work(
    workshop: Path, out: str, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(*_: object, **__: object) -> None:
        pytest.fail("must not get here")

    monkeypatch.chdir(workshop)
    monkeypatch.setattr(scenes, "load_mesh", work)
    monkeypatch.setattr(Run, "render", work)
    (workshop / "pictures").mkdir(exist_ok=True)
    (workshop / "pictures" / "holiday.png").write_text("")
    assert "choose another name" in refusal([*command.split(), "--overwrite", "--out", out], capsys)


@pytest.mark.parametrize("command", ["report", "evaluate"])
def test_a_report_is_not_written_through_a_link(
    workshop: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(workshop / "run", run)
    shutil.rmtree(run / "report")
    (run / "metrics.json").unlink()
    outside.mkdir()
    (run / "report").symlink_to(outside)
    assert "report is a link" in refusal([command, str(run)], capsys)
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
def test_a_full_disk_changes_nothing(
    workshop: Path, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def everything() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in workshop.rglob("*") if path.is_file()}

    before = everything()
    monkeypatch.chdir(workshop)
    monkeypatch.setattr(os, "fsync", refuse)
    with few_samples():
        assert "the disk is full; free some space" in refusal(command.split(), capsys)
    assert everything() == before


def test_info_on_rendered_images(workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "images"
    sweep = ["--azimuth", "0:90:45", "--grazing", "30", "--out", str(out)]
    assert main(["render", str(workshop / "run"), *sweep]) == 0
    capsys.readouterr()
    assert main(["info", str(out)]) == 0
    said = capsys.readouterr().out
    assert "2 rendered images" in said
    assert "az000_gr30 … az045_gr30" in said
    for path in out.glob("*.tif"):
        path.unlink()
    assert "no longer contains its images" in refusal(["info", str(out)], capsys)


def test_info_on_a_run_whose_dataset_has_moved(
    workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(workshop / "run", run)
    capsys.readouterr()
    assert main(["info", str(run)]) == 0
    before = capsys.readouterr().out.split()
    header = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**header, "dataset": str(tmp_path / "gone")}))
    assert main(["info", str(run)]) == 0
    after = capsys.readouterr().out
    assert "(no longer there)" in after
    assert after.split()[-20:] == before[-20:]  # iterations, Gaussians, points: as with the dataset
    for results in ("gaussians.ply", "points.ply"):
        (run / results).unlink()
    assert main(["info", str(run)]) == 0
    assert capsys.readouterr().out.split()[-20:] == before[-20:]  # made anew


@pytest.mark.parametrize("part", ["run/config.json", "run/report", "run/report/index.html", "dataset/dataset.json"])
def test_info_points_from_a_part_to_the_whole(workshop: Path, part: str, capsys: pytest.CaptureFixture[str]) -> None:
    whole = workshop / part.partition("/")[0]
    assert f"is part of the {whole.name} {whole}; give that folder" in refusal(["info", str(workshop / part)], capsys)


@pytest.mark.parametrize(
    ("reason", "verdict"),
    [("", "agrees with the CPU engine"), ("its images differ", "not used unless asked for by name: its images differ")],
)
def test_doctor_names_the_gpu(
    reason: str, verdict: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sarsplat.renderer.trial.objection", lambda device: reason)
    monkeypatch.setattr(import_module("sarsplat.renderer.cuda_device"), "require_cuda", lambda: None)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "Some GPU")
    monkeypatch.setattr(import_module("sarsplat.renderer.nvrtc"), "Nvrtc", lambda: SimpleNamespace(version="12.8"))
    assert main(["doctor"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"Some GPU, compiled at first use by NVRTC 12.8; {verdict}" in said


def test_doctor_knows_what_is_installed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"cuda +(not usable: the CUDA engine needs|not usable: torch|\S.* by NVRTC \d)", said)
    assert "trimesh" in said
    assert "SARSPLAT_LPIPS_WEIGHTS" in said
