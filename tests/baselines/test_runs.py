"""What all methods share: trainings that can be resumed, runs that every command understands, and what is refused."""

import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from made_runs import assert_same
from sarsplat import Dataset, ImageGrid, Run, SarsplatError, View, evaluate_run, reconstruct, write_report
from sarsplat.baselines import BaselineMethod, Scene, soft_raster
from sarsplat.baselines.mesh_renderer import MeshRenderer
from sarsplat.baselines.meshes import cube_sphere
from sarsplat.baselines.method_dsr import Dsr, DsrConfig
from sarsplat.baselines.method_sar_nerf_grid import SarNerfGrid, SarNerfGridConfig
from sarsplat.baselines.soft_raster import Lattice, soft_coverage
from sarsplat.baselines.trainer import scene_of
from sarsplat.cli.app import run as command
from sarsplat.data import read_points_ply
from sarsplat.evaluation.points import on_surface
from sarsplat.runs import METHODS

BASELINES = cast("Mapping[str, BaselineMethod]", METHODS)
SHORT = {"sar-nerf": 2, "sar-nerf-grid": 6, "dsr": 4}
EVERY = pytest.mark.parametrize("method", SHORT)


def short(method: str):
    settings = BASELINES[method].defaults
    few = {"surface_voxels": 12, "rays": 2} if hasattr(settings, "rays") else {}
    return replace(settings, iterations=SHORT[method], checkpoint_every=max(1, SHORT[method] // 3), **few)


def trained(method: str, small_box: Dataset, out: Path | None = None, **options) -> Run:
    masks = small_box.path / "masks" if method == "dsr" and not options.get("resume") else None
    return reconstruct(small_box, short(method), out, method=method, masks=masks, device="cpu", quiet=True, **options)


@pytest.fixture(scope="module")
def finished(small_box: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a method's run, trained once."""

    @cache
    def of(method: str) -> Path:
        folder = tmp_path_factory.mktemp(method) / "run"
        trained(method, small_box, folder)
        return folder

    return of


@pytest.fixture
def run_of(finished: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """A copy of it, to work on: tmp_path/run."""
    return lambda method: shutil.copytree(finished(method), tmp_path / "run")


def test_every_method_is_tested():
    assert {*SHORT, "sar-gs"} == {*METHODS}


def test_a_corner_reflector_does_not_scale_a_scene(small_box: Dataset) -> None:
    plain = scene_of(small_box)
    largest = float(small_box.images("train").max())
    assert plain.brightest == largest / plain.unit  # which nothing outshines
    power = small_box.power.copy()
    power[:, 2, 2] = 1e4 * largest
    outshone = scene_of(replace(small_box, power=power))
    assert 1 <= outshone.brightest * outshone.unit / largest < 100
    assert outshone.brightest * outshone.unit < power.max() / 50


@EVERY
def test_a_resumed_training_ends_with_the_same_bits(method, small_box, tmp_path, finished):
    whole = Run.load(finished(method))
    stop = SHORT[method] // 2

    def leave(step):
        if step.iteration == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(method, small_box, tmp_path / "run", on_step=leave)
    assert Run.load(tmp_path / "run").iteration == stop
    resumed = trained(method, small_box, tmp_path / "run", resume=True)
    assert resumed.iteration == SHORT[method]
    assert_same(resumed.snapshot, whole.snapshot)
    assert [line.loss for line in resumed.history][-1] == [line.loss for line in whole.history][-1]


@EVERY
def test_its_run_is_rendered_scored_and_shown(method, tmp_path, run_of):
    run_of(method)
    with pytest.raises(SarsplatError, match="device 'gpu' is unknown; choose auto, cpu or cuda"):
        Run.load(tmp_path / "run", "gpu")
    assert Run.load(tmp_path / "run", "auto").device in ("cpu", "cuda")
    run = Run.load(tmp_path / "run")
    assert run.method == method
    assert run.render([View(10, 40), View(200, 60)]).shape == (2, 28, 24)
    assert set(np.unique(run.masks([View(10, 40)]))) <= {0, 1, 2}
    metrics = evaluate_run(run, quiet=True)
    assert metrics["method"] == method
    assert np.isfinite(metrics["images"]["test"]["psnr_db"])
    page = write_report(run).read_text()
    assert METHODS[method].title in page
    assert f"{method}, visible surface" in page or len(run.points) == 0
    points, columns = read_points_ply(tmp_path / "run" / "points.ply")
    np.testing.assert_array_equal(points, run.points)
    assert {"nx", "ny", "nz"} <= set(columns)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "quick", "most", "most_m"),
    [
        ("sar-nerf-grid", {"iterations": 300, "surface_voxels": 64}, 0.05, 0.2),
        ("dsr", {"iterations": 120, "scattering_rate": 0.1}, 0.15, 0.4),
    ],
)
def test_a_box_on_the_ground_is_found(method, quick, most, most_m, small_box):
    """In unseen images, of cells of 0.3 m, and as a surface; the perceptron would take hours."""
    masks = small_box.path / "masks" if method == "dsr" else None
    settings = replace(BASELINES[method].defaults, **quick)
    run = reconstruct(small_box, settings, method=method, masks=masks, device="cpu", quiet=True)
    test = small_box.select("test")
    true = np.sqrt(test.power)
    assert np.square(np.sqrt(run.render(test.views)) - true).sum() < most * np.square(true).sum()
    assert evaluate_run(run, quiet=True)["points"]["visible"]["cd_m"] < most_m


def test_points_lie_on_what_the_radar_sees(run_of):
    run = Run.load(run_of("dsr"))
    surface = run.mesh()
    assert len(run.points) > 200
    assert on_surface(run.points, np.asarray(surface.triangles))[0].max() < 1e-4
    _, face = cKDTree(surface.triangles_center).query(run.points)
    np.testing.assert_allclose(np.linalg.norm(run.normals, axis=1), 1, atol=1e-5)
    along = np.abs((run.normals * surface.face_normals[face]).sum(axis=1))
    assert np.median(along) > 0.95
    towards = np.array([view.direction for view in run.snapshot.views])
    assert (run.normals @ towards.T).max(axis=1).min() > -1e-6


def test_a_method_is_not_taken_for_another(small_box, tmp_path, run_of):
    run_of("sar-nerf-grid")
    assert Run.load(tmp_path / "run").gaussians is None
    with pytest.raises(SarsplatError, match="was started with the method sar-nerf-grid, not dsr; resume it with that"):
        trained("dsr", small_box, tmp_path / "run", resume=True)
    header = tmp_path / "run" / "config.json"
    header.write_text(json.dumps({**json.loads(header.read_text()), "method": "magic"}))
    with pytest.raises(SarsplatError, match="there is no method 'magic'; choose one of sar-gs, "):
        Run.load(tmp_path / "run")
    assert command(["reconstruct", str(small_box.path), "--out", str(tmp_path / "run"), "--resume"]) == 2


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("optimiser/0/exp_avg", None),
        ("optimiser/0/exp_avg_sq", lambda tensor: tensor * torch.nan),
        ("optimiser/0/step", lambda tensor: -tensor),
        ("model/moved", lambda tensor: tensor.double()),
        ("scene/looks", lambda tensor: tensor - 1),
        ("scene/low_m", None),
        ("scene/masks", lambda tensor: tensor.float()),
        ("scene/masks", lambda tensor: tensor[1:]),
    ],
)
def test_a_damaged_checkpoint_is_refused_before_anything_is_lost(name, change, small_box, tmp_path, run_of):
    from sarsplat.data import load_checkpoint, save_checkpoint

    run_of("dsr")
    path = Run.load(tmp_path / "run").store.checkpoint_path
    assert path is not None
    tensors, state = load_checkpoint(path)
    damaged = tensors.pop(name)
    save_checkpoint(path, tensors if change is None else {**tensors, name: change(damaged)}, state)
    with pytest.raises(SarsplatError, match=r"does not match this version|does not hold a whole model"):
        trained("dsr", small_box, tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "points.ply").is_file()
    if not name.startswith("optimiser"):
        with pytest.raises(SarsplatError, match="does not hold a whole model"):
            Run.load(tmp_path / "run").render([View(0, 30)])


def test_a_run_that_lost_its_checkpoints_takes_masks_again(small_box, tmp_path, run_of):
    run_of("dsr")
    for path in (tmp_path / "run" / "checkpoints").iterdir():
        path.unlink()
    with pytest.raises(SarsplatError, match=r"^.*run holds no checkpoint; "):
        Run.load(tmp_path / "run").render([View(0, 30)])
    words = {"method": "dsr", "masks": small_box.path / "masks", "resume": True, "quiet": True}
    run = reconstruct(small_box, out=tmp_path / "run", **words)
    assert run.iteration == SHORT["dsr"]
    with pytest.raises(SarsplatError, match="keeps the masks it was started with"):
        reconstruct(small_box, out=tmp_path / "run", **words)


def test_what_the_surface_is_made_of_is_kept(tmp_path, run_of):
    run_of("dsr")
    kept, anew = Run.load(tmp_path / "run"), Run.load(tmp_path / "run")
    before = kept.mesh().vertices
    (tmp_path / "run" / "mesh.ply").unlink()
    np.testing.assert_allclose(before, anew.mesh().vertices, atol=1e-5)


def test_the_command_line_trains_and_goes_on(small_box, tmp_path, capsys):
    out = str(tmp_path / "run")
    words = ["reconstruct", str(small_box.path), "--out", out]
    masks = ["--masks", str(small_box.path / "masks")]
    assert command([*words, "--method", "dsr", *masks, "--iterations", "3", "--seed", "5"]) == 0
    assert (Run.load(out).iteration, Run.load(out).seed) == (3, 5)
    assert command([*words, "--resume", "--iterations", "5"]) == 0
    assert Run.load(out).iteration == 5
    for arguments in (["render", out, "--out", f"{out}-images", "--azimuth", "5", "--grazing", "30"], ["info", out]):
        assert command(arguments) == 0
    assert command(["export", out, f"{out}.glb"]) == 0
    assert command(["export", out, f"{out}.ply", "--format", "points"]) == 0
    capsys.readouterr()
    assert command(["export", out, f"{out}-gaussians.ply"]) == 2
    assert "learns no Gaussians; " in " ".join(capsys.readouterr().err.split())


def test_settings_come_from_a_file(small_box, tmp_path, capsys):
    words = ["reconstruct", str(small_box.path), "--method", "sar-nerf-grid", "--out", str(tmp_path / "run")]
    assert command([*words, "--print-config"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["method"] == "sar-nerf-grid"
    settings, file = written["config"], tmp_path / "settings.json"
    file.write_text(json.dumps({**written, "config": {**settings, "degree": 1, "iterations": 4, "surface_voxels": 24}}))
    assert command([*words, "--config", str(file), "--iterations", "3"]) == 0
    config = Run.load(tmp_path / "run").config
    assert (config.as_dict()["degree"], config.iterations) == (1, 3)
    for other in ([], ["--method", "dsr"]):
        given = ["reconstruct", str(small_box.path), "--out", str(tmp_path / "other"), "--config", str(file), *other]
        assert command(given) == 2
        wrong = f"holds settings of 'sar-nerf-grid', not of {'dsr' if other else 'sar-gs'}; give that as --method"
        assert wrong in " ".join(capsys.readouterr().err.split())


# ---- scenes, masks, settings, meshes and training arguments, each refused in a sentence ------------------------------
GRID, LOW, HIGH = ImageGrid(24, 20, (0.3, 0.35), (0.3, 0.35)), np.array([-0.9, -0.6, 0.0]), np.array([1.3, 0.6, 1.8])
SCENE = Scene((View(10, 35), View(100, 35)), GRID, LOW, HIGH, 1.0)


def masked(masks: np.ndarray | None) -> Dsr:
    return Dsr(replace(SCENE, masks=masks), DsrConfig())


def in_the_sky() -> torch.Tensor:
    """The loss of a box that no image shows, of which nothing can be learned."""
    above = np.array([0.0, 0.0, 50.0])
    model = SarNerfGrid(replace(SCENE, low_m=LOW + above, high_m=HIGH + above), SarNerfGridConfig())
    assert model.image(SCENE.views[0]).max() == 0
    return model.loss(torch.tensor([0]), torch.zeros(1, GRID.rows, GRID.columns), torch.Generator())


def covered(corner: float) -> soft_raster.Coverage:
    corners = torch.tensor([[[-1.0, -0.7], [1.1, -0.6], [0.2, corner]]])
    return soft_coverage(corners, Lattice.of(GRID), 0.3)


def rendered(corner: float) -> object:
    template = cube_sphere(2)
    points = torch.from_numpy(template.vertices).clone()
    points[3, 1] = corner
    return MeshRenderer(GRID, 0.1, 0.1).layers(
        points, torch.from_numpy(template.faces), torch.ones(len(template.faces), dtype=points.dtype), View(20, 30)
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: replace(SCENE, high_m=LOW), "is empty or not finite"),
        (lambda: replace(SCENE, low_m=np.array([np.nan, 0, 0])), "is empty or not finite"),
        (lambda: masked(None), "but masks is None; give their folder"),
        (lambda: masked(np.zeros((2, 24, 20), np.uint8)), "no mask shows the target"),
        (lambda: replace(DsrConfig(), vertices=641), "vertices is 641; it must be one of 642, 1352"),
        (lambda: replace(DsrConfig(), betas=(0.5, 1.5)), r"it must be 2 values, each a number from 0 to 0\.9999"),
        (in_the_sky, "appears in none of the 1 training images; give the box"),
        (lambda: SarNerfGrid(SCENE, SarNerfGridConfig(voxel=1e-3)), "give a larger voxel"),
        (lambda: covered(math.nan), "a vertex of the mesh is not finite"),
        (lambda: rendered(math.nan), "nan m away"),
    ],
)
def test_models_refuse(call: Callable[[], object], message: str) -> None:
    with pytest.raises(SarsplatError, match=message):
        call()


def test_too_many_pairs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soft_raster, "_MOST_PAIRS", 10)
    with pytest.raises(SarsplatError, match="more than 10"):
        covered(1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": DsrConfig()}, "the settings are a DsrConfig; sar-nerf-grid takes a SarNerfGridConfig"),
        ({"masks": "masks"}, "sar-nerf-grid uses no masks; omit 'masks', or choose a method that does"),
        ({"preset": "paper"}, "sar-nerf-grid has no presets, so 'paper' is unknown"),
        ({"loss": len}, "sar-nerf-grid uses no loss; omit "),
        ({"strategies": [1]}, r"sar-nerf-grid uses no strategies; omit \(1,\)"),
        ({"out": "run", "resume": False, "overwrite": True, "device": "gpu"}, "device 'gpu' is unknown"),
    ],
)
def test_trainings_refuse(arguments, message, small_box):
    with pytest.raises(SarsplatError, match=message):
        reconstruct(small_box, quiet=True, **{"method": "sar-nerf-grid", **arguments})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "dsr", "--gaussians", "100"], "--gaussians is not a setting of dsr; change those"),
        (["--method", "sar-nerf", "--rates.means", "0.1"], "--rates.means is not a setting of sar-nerf; "),
        (["--method", "dsr", "--masks", "nowhere"], "nowhere has no mask of 12 of 12 training images"),
        (["--method", "dsr", "--view"], "--view cannot show a training by dsr; omit it"),
    ],
)
def test_the_command_refuses(options, message, small_box, tmp_path, capsys):
    assert command(["reconstruct", str(small_box.path), "--out", str(tmp_path / "run"), *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()
