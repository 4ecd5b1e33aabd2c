"""What researchers bend: trainings in memory, with a loss or a method of their own, and images left out."""

import itertools
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sarsplat
from made import dataset_of
from programs import python
from sarsplat import Config, Dataset, ImageGrid, Run, SarsplatError, View, preset, reconstruct
from sarsplat.data import read_gaussians_ply, read_points_ply, write_points_ply
from sarsplat.gaussians import SCATTERINGS
from sarsplat.learning.training_images import ViewQueue

NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@pytest.fixture
def short(config: Config) -> Config:
    return replace(config, iterations=6, gaussians=80, checkpoint_every=4)


def test_a_run_in_memory_is_the_same_as_one_on_the_disk(dataset: Dataset, config: Config, finished: Run) -> None:
    held = reconstruct(dataset, config, quiet=True)
    assert held.path is None
    assert torch.equal(held.gaussians.means, finished.gaussians.means)
    assert np.array_equal(held.points, finished.points)
    views = [View(10.0, 30.0), View(200.0, 50.0)]
    assert np.array_equal(held.render(views), finished.render(views))
    assert [line.loss for line in held.history] == [line.loss for line in finished.history]
    assert (held.iteration, held.metrics, held.dataset) == (60, None, dataset)
    with pytest.raises(SarsplatError, match="either resumed or overwritten"):
        reconstruct(dataset, config, resume=True)


def test_a_run_needs_its_dataset_for_images_alone(
    dataset: Dataset, short: Config, tmp_path: Path, finished: Run
) -> None:
    shutil.copytree(dataset.path, tmp_path / "dataset")
    made = reconstruct(str(tmp_path / "dataset"), short, str(tmp_path / "run"), quiet=True)
    expected = made.gaussians.tensors(), made.points, made.render([View(10.0, 30.0)])
    shutil.rmtree(tmp_path / "dataset")
    (tmp_path / "run" / "points.ply").unlink()
    alone = Run.load(str(tmp_path / "run"))
    assert all(torch.equal(tensor, alone.gaussians.tensors()[name]) for name, tensor in expected[0].items())
    assert np.array_equal(alone.points, expected[1])
    assert np.array_equal(alone.render([View(10.0, 30.0)]), expected[2])
    assert alone.grid == dataset.grid
    assert alone.brightest == dataset.images("train").max()
    with pytest.raises(SarsplatError, match="needs its dataset, which is no longer at"):
        _ = alone.dataset


def test_normals_are_read_with_the_points_and_computed_where_they_are_missing(finished: Run, tmp_path: Path) -> None:
    shutil.copytree(finished.folder, tmp_path / "run")
    points, columns = read_points_ply(tmp_path / "run" / "points.ply")
    read = Run.load(tmp_path / "run")
    assert np.array_equal(read.normals[:, 2], columns["nz"])
    read.points[0] = read.normals[0] = 5.0  # copies: scores, report and exports stay the same
    assert np.array_equal(read.points, finished.points) and np.array_equal(read.normals[:, 2], columns["nz"])
    write_points_ply(tmp_path / "run" / "points.ply", points, normals=np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    assert (Run.load(tmp_path / "run").normals == [0, 0, 1]).all()
    write_points_ply(tmp_path / "run" / "points.ply", points)
    computed = Run.load(tmp_path / "run").normals
    np.testing.assert_allclose(computed[:, 2], columns["nz"], atol=1e-5)


def test_a_run_says_what_it_is_and_renders_where_it_is_told_to(finished: Run) -> None:
    assert repr(finished) == f"Run({finished.path}, sar-gs, {finished.config.preset}, seed {finished.seed})"
    assert replace(Run.load(finished.folder), device="meta").gaussians.means.device.type == "meta"
    assert Run.load(finished.folder).gaussians.means.device.type == "cpu"


def test_a_loss_of_ones_own(dataset: Dataset, config: Config) -> None:
    shapes = set()

    def squares(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        shapes.add((rendered.shape, truth.shape))
        return (rendered - truth).square().mean()

    run = reconstruct(dataset, replace(config, iterations=40), loss=squares, quiet=True)
    assert run.config.loss == "squares"
    assert shapes == {((4, 32, 32), (4, 32, 32))}
    assert run.history[-1].loss < 0.5 * run.history[0].loss
    assert run.render([]).shape == (0, 32, 32)
    error = run.render(dataset.select("train").views) - dataset.images("train")
    assert np.square(error).mean() < 0.5 * run.history[0].loss  # β⁰ and no other unit


def amplitude(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    return (rendered - truth).abs().mean()


def test_a_loss_of_ones_own_does_not_pass_for_a_known_one(dataset: Dataset, config: Config, tmp_path: Path) -> None:
    run = reconstruct(dataset, replace(config, iterations=2), tmp_path / "run", loss=amplitude, quiet=True)
    assert run.config.loss == "own amplitude"
    with pytest.raises(SarsplatError, match="loss 'own amplitude' is unknown"):
        reconstruct(dataset, out=tmp_path / "run", resume=True, quiet=True)


@pytest.mark.parametrize("law", sorted(set(SCATTERINGS) - {"polarimetric"}))  # which needs several polarisations
def test_every_law_is_learned_and_resumed(law: str, dataset: Dataset, config: Config, tmp_path: Path) -> None:
    short = {"iterations": 16, "checkpoint_every": 8, "harmonics_every": 3, "gaussians": 200}
    config = replace(config, **short, scattering=law, surroundings=preset("measured").surroundings)
    whole = reconstruct(dataset, config, quiet=True)

    begun = reconstruct(dataset, config, tmp_path / "run", on_step=lambda step: step.iteration == 10, quiet=True)
    assert begun.iteration == 10
    resumed = reconstruct(dataset, config, tmp_path / "run", resume=True, quiet=True)
    assert resumed.gaussians.scattering.kind == law
    assert torch.equal(resumed.gaussians.scattering.parameters, whole.gaussians.scattering.parameters)
    *own, last = resumed.gaussians.scattering.parameters.T  # every column was learned
    assert all(column.std() > 0 for column in own)
    start = SCATTERINGS[law].initial(1, 0.5, 0.03)
    assert last[0] != start.parameters[0, -1] if start.common else last.std() > 0
    written = read_gaussians_ply(tmp_path / "run" / "gaussians.ply")
    assert written.scattering.kind == law
    assert torch.equal(written.scattering.parameters, whole.gaussians.scattering.parameters)


def test_quiet_is_quiet_and_no_signal_handler_is_touched(
    dataset: Dataset, short: Config, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("signal.signal", None)
        reconstruct(dataset, short, quiet=True)
    assert capsys.readouterr() == ("", "")
    reconstruct(dataset, short)
    assert "reconstruct (default): 6/6" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"device": "tpu"}, "device 'tpu' is unknown"),
        ({"preset": replace(preset("default"), loss="amplitud")}, "loss 'amplitud' is unknown; did you mean amplitude"),
        pytest.param({"device": "cuda"}, "install .*, or use the CPU", marks=NO_GPU),
        ({"loss": lambda a, b: (a - b).square()}, r"returned \(4, 32, 32\) of torch.float32;"),
        ({"loss": lambda a, b: (a - b).square().mean().detach()}, r"returned \(\) of"),
        ({"loss": lambda a, b: (a - b).mean() * 1j}, r"returned \(\) of torch.complex64"),
        ({"loss": lambda a, b: 0.5}, "returned float"),
    ],
)
def test_refusals(dataset: Dataset, short: Config, options: dict[str, Any], words: str) -> None:
    with pytest.raises(SarsplatError, match=words):
        reconstruct(**{"dataset": dataset, "preset": short, "quiet": True, **options})


def test_a_setting_that_is_given_as_an_argument_is_told_where_it_belongs(dataset: Dataset) -> None:
    for name, told in (("iterations", r"'iterations'; it is a setting.*, iterations=20\)"), ("devise", "mean device")):
        with pytest.raises(TypeError, match=told):
            reconstruct(dataset, **{name: 20})


@pytest.mark.parametrize(("iterations", "first"), [(1000, 1), (6, 6)])  # without a line of the log before the next step
def test_a_loss_that_becomes_no_number_is_named_and_not_saved(
    dataset: Dataset, short: Config, tmp_path: Path, iterations: int, first: int
) -> None:
    def breaks(rendered: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        return (rendered - truth).square().mean() * next(factors)

    factors = itertools.chain([1.0] * first, itertools.repeat(math.nan))  # the first call is of black images
    with pytest.raises(SarsplatError, match=f"the loss became nan at iteration {first}"):
        reconstruct(dataset, replace(short, iterations=iterations), tmp_path / "run", loss=breaks, quiet=True)
    assert first == 1 or Run.load(tmp_path / "run").iteration == 4


@pytest.mark.parametrize(("name", "words"), [("measured", "ground is on"), ("texture", "texture_looks")])
def test_no_ground_is_learned_of_what_is_aloft(name: str, words: str) -> None:
    views = [(View.isar((1, 0.2 * k, -0.4), (0, 0.3, 1)), "train") for k in range(4)]
    power = np.random.default_rng(0).exponential(size=(4, 16, 16)).astype(np.float32)
    aloft = dataset_of(ImageGrid(16, 16, (0.3, 0.3), (0.3, 0.3)), views, power, looks=1.0)
    config = preset("measured") if name == "measured" else replace(preset("measured"), ground=None)
    with pytest.raises(SarsplatError, match=f"target aloft, where there is no ground, but {words}"):
        reconstruct(aloft, config, quiet=True)


# ---- methods as such -------------------------------------------------------------------------------------------------
def test_names_need_no_torch():
    code = "import sys; from sarsplat.runs import METHODS; print(*METHODS, 'torch' in sys.modules)"
    assert python("-c", code).stdout.split() == ["sar-gs", "dsr", "sar-nerf", "sar-nerf-grid", "False"]


def test_a_run_in_a_folder_of_images_in_memory_has_them(dataset: Dataset, config: Config, tmp_path: Path):
    in_memory = replace(dataset, path=None)
    run = reconstruct(in_memory, replace(config, iterations=2), tmp_path / "run", quiet=True)
    assert run.dataset is in_memory
    alone = Run.load(tmp_path / "run")
    with pytest.raises(SarsplatError, match=r"made from images in memory; give them with Run\.load"):
        _ = alone.dataset
    assert Run.load(tmp_path / "run", dataset=in_memory).dataset is in_memory
    other = replace(in_memory, power=2 * in_memory.power)
    with pytest.raises(SarsplatError, match="was made from another dataset than"):
        Run.load(tmp_path / "run", dataset=other)


def test_views_are_drawn_on_the_cpu_whatever_torchs_default_device():
    queue = ViewQueue(5, 2, torch.Generator().manual_seed(0))
    with torch.device("meta"):
        drawn = [*queue.next(), *queue.next(), *queue.next()]
    assert sorted(drawn[:5]) == [0, 1, 2, 3, 4]
    assert len(queue.waiting) == 4


def test_a_queue_resumes_where_it_stopped(finished: Run):
    queue = ViewQueue(12, 8, torch.Generator())
    queue.restore(finished.snapshot)
    assert queue.waiting == list(finished.snapshot.queue)
    for damaged in ({"queue": (12,)}, {"views": finished.snapshot.views[:3]}):
        with pytest.raises(ValueError, match="views"):
            queue.restore(replace(finished.snapshot, **damaged))


def test_a_method_of_another_package_is_one_of_the_methods(tmp_path: Path):
    """The whole page of docs/how-to/another-method.md is such a method; here, that it is found and reached."""
    (tmp_path / "flat.py").write_text("from sarsplat.learning.method_sar_gs import SarGs\nMETHOD = SarGs()\n")
    info = tmp_path / "flat-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: flat\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[sarsplat.methods]\nflat = flat:METHOD\n")
    code = "from sarsplat.cli import main; main(['reconstruct', '--help'])"
    path = {"PYTHONPATH": f"{tmp_path}:{Path(sarsplat.__file__).parent.parent}"}
    done = python("-c", code, env={**os.environ, **path})
    assert "sar-nerf-grid,flat}" in "".join(done.stdout.split()), done.stderr
