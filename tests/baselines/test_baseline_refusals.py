"""What baselines refuse: scenes, masks, settings, meshes and training arguments, each in a sentence."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from sarsplat import SarsplatError, reconstruct
from sarsplat.baselines import soft_raster
from sarsplat.baselines.baseline import Scene
from sarsplat.baselines.mesh_renderer import MeshRenderer
from sarsplat.baselines.meshes import cube_sphere
from sarsplat.baselines.method_dsr import Dsr, DsrConfig
from sarsplat.baselines.method_sar_nerf_grid import SarNerfGrid, SarNerfGridConfig
from sarsplat.baselines.soft_raster import Lattice, soft_coverage
from sarsplat.cli.app import run as command
from sarsplat.geometry import ImageGrid, View

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
        (lambda: masked(np.zeros((3, 24, 20), np.uint8)), "the masks are of shape"),
        (lambda: masked(np.zeros((2, 24, 20), np.uint8)), "no mask shows the target"),
        (lambda: masked(np.full((2, 24, 20), 3, np.uint8)), "a mask holds the number 3"),
        (lambda: replace(DsrConfig(), vertices=641), "vertices is 641; it must be one of 642, 1352"),
        (lambda: replace(DsrConfig(), betas=(0.5, 1.5)), r"it must be 2 values, each a number from 0 to 0\.9999"),
        (in_the_sky, "appears in none of the 1 training images; give the box"),
        (lambda: SarNerfGrid(SCENE, SarNerfGridConfig(voxel=1e-3)), "give a larger voxel"),
        (lambda: covered(math.nan), "a vertex of the mesh is not finite"),
        (lambda: covered(math.inf), "a vertex of the mesh is not finite"),
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
        ({"method": "magic"}, "there is no method 'magic'; choose one of sar-gs, "),
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
        (["--masks", "masks"], "sar-gs uses no masks; omit 'masks'"),
        (["--method", "magic"], "magic"),
        (["--method", "dsr", "--masks", "nowhere"], "nowhere has no mask of 12 of 12 training images"),
        (["--method", "dsr", "--view"], "--view cannot show a training by dsr; omit it"),
    ],
)
def test_the_command_refuses(options, message, small_box, tmp_path, capsys):
    assert command(["reconstruct", str(small_box.path), "--out", str(tmp_path / "run"), *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()
