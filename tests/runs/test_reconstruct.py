"""The trainer on a small box: it learns, resumes bit for bit, and leaves a usable run whenever it stops."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from made_runs import assert_same, trained
from sarsplat import Config, Dataset, Run, SarsplatError, SarsplatWarning, Trainer, View, preset, reconstruct
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.measured import gains
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.regions.target_box import target_box
from sarsplat.runs import Step, training_loop
from sarsplat.runs.training_loop import ThreadChoice
from sarsplat.settings.sections import FlatGround, Surroundings

BOX = (3.0, 2.0, 1.2)


def test_it_learns_what_unseen_views_show(finished: Run, dataset: Dataset) -> None:
    truth = np.sqrt(dataset.images("test"))
    rendered = np.sqrt(finished.render(dataset.select("test").views))
    assert np.linalg.norm(rendered - truth) / np.linalg.norm(truth) < 0.25
    assert finished.history[-1].loss < 0.3 * finished.history[0].loss
    assert finished.iteration == 60


def test_points_lie_on_the_box(finished: Run) -> None:
    points = finished.points
    outside = np.maximum(np.abs(points - (0, 0, BOX[2] / 2)) - np.array(BOX) / 2, 0)
    assert len(points) > 200
    assert np.linalg.norm(outside, axis=1).mean() < 0.15


def test_a_run_reads_back_as_it_was(finished: Run) -> None:
    again = Run.load(finished.path)
    assert again.config == finished.config
    assert_same(again.snapshot, finished.snapshot)
    assert sorted(p.name for p in finished.path.iterdir()) == [
        *("about.json", "checkpoints", "config.json", "gaussians.ply", "metrics.jsonl", "points.ply")
    ]


def test_a_stopped_training_resumes_to_the_bit(dataset: Dataset, config: Config, tmp_path: Path, finished: Run) -> None:
    def stop(step: Step) -> None:
        if step.iteration == 37:  # between checkpoints
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(dataset, config, tmp_path / "stopped", on_step=stop)
    stopped = Run.load(tmp_path / "stopped")
    assert stopped.iteration == 37
    assert stopped.render([View(10.0, 30.0)]).shape == (1, 32, 32)  # usable as it is
    assert_same(reconstruct(dataset, config, tmp_path / "stopped", resume=True).snapshot, finished.snapshot)


def test_measured_scenes_have_ground_noise_and_their_own_shifts(dataset: Dataset) -> None:
    config = replace(preset("measured"), gaussians=200, iterations=5)
    trainer = Trainer(dataset, config)
    before = {name: tensor.detach().clone() for name, tensor in trainer.model.parameters.items()}
    for _ in range(5):
        assert bool(trainer.step().isfinite())
    for name, tensor in trainer.model.parameters.items():
        assert not torch.equal(before[name], tensor), name
    with torch.no_grad():
        images, _ = trainer.model.render([View(0.0, 20.0)], dataset.grid, 0, estimated=False)
    floor = float(trainer.model.parameters["noise"].detach().exp()) * trainer.model.unit
    assert float(images.min()) >= floor * (1 - 1e-6)


def test_every_term_of_measured_scenes_can_be_switched_off(dataset: Dataset) -> None:
    off = Surroundings(shift_std=0, gain_std=0, side_lobes=0, texture_looks=0)
    few = replace(preset("measured"), gaussians=200, iterations=5)
    config = replace(few, ground=FlatGround(pitch=0), surroundings=off, dropout=0, sparsity=0, directional_std=None)
    trainer = trained(dataset, config, 5)
    parameters = trainer.model.parameters
    assert not parameters.keys() & {"log_side_lobes", "ground_texture"}
    for name in ("shift", "log_gain"):
        assert not parameters[name].detach().any(), name
    assert trainer.model.penalty() is None
    assert not any(name.startswith("part/") for name in trainer.model.tensors())
    assert bool(Trainer(dataset, replace(few, harmonics_degree=0)).step().isfinite())
    airborne = Trainer(dataset, replace(config, ground=None))
    assert bool(airborne.step().isfinite())
    assert airborne.model.ground() is None


def test_the_floor_of_an_unseen_chip_is_the_mean_over_gains(dataset: Dataset) -> None:
    """A chip of little gain shows little but its floor; scaled to the mean gain, its floor is high."""
    trainer = Trainer(dataset, replace(preset("measured"), gaussians=20))
    parameters = {name: tensor.detach().clone() for name, tensor in trainer.model.parameters.items()}
    parameters["log_gain"][0] -= 3
    parameters["optical_depth"][:] = 1e-3
    parameters["ground"][0] = -60  # black
    uneven = SceneModel(replace(trainer.config, p_min=0), trainer.model.frame, parameters)
    factors = gains(uneven.parameters).numpy(force=True)
    assert factors.mean() == pytest.approx(1)
    with torch.no_grad():
        images, _ = uneven.render([View(0.0, 20.0)], dataset.grid, 0)
    floor = float(parameters["noise"].exp()) * uneven.unit
    assert float(images.min()) == pytest.approx(floor * (1 / factors).mean(), rel=1e-3)


def test_unseen_chips_are_displaced_as_the_others_on_average(dataset: Dataset) -> None:
    trainer = Trainer(dataset, replace(preset("measured"), gaussians=200))
    model, view, grid = trainer.model, View(0.0, 20.0), dataset.grid
    with torch.no_grad():
        model.parameters["shift"][:] = torch.tensor([2 * grid.spacing_m[0], -grid.spacing_m[1]])
        displaced, _ = model.render([view], grid, 0)
        as_displaced = model.as_displaced(grid)
        model.parameters["shift"].zero_()
        centred, _ = model.render([view], grid, 0)
        same, _ = model.render([view], as_displaced, 0)
    torch.testing.assert_close(displaced, same)
    torch.testing.assert_close(displaced[0, 3:-4, 6:-4], torch.roll(centred[0], (-1, 2), (0, 1))[3:-4, 6:-4])


def test_directions_need_more_than_two_views_for_each_coefficient(dataset: Dataset) -> None:
    model = Trainer(dataset, replace(preset("measured"), gaussians=20)).model
    unlimited = replace(model.config, views_per_coefficient=0)
    for views, degree in ((1, 0), (8, 0), (9, 1), (18, 1), (19, 2), (32, 2), (33, 3), (200, 3)):
        model.frame = replace(model.frame, views=(View(0.0, 30.0),) * views)
        assert model.degree(800) == degree
        assert SceneModel.degree(SimpleNamespace(config=unlimited, frame=model.frame), 800) == 3


def test_priors_are_nats_of_normal_distributions(dataset: Dataset) -> None:
    trainer = Trainer(dataset, replace(preset("measured"), gaussians=20, sparsity=0.3))
    model, settings, ground = trainer.model, preset("measured").surroundings, preset("measured").ground
    with torch.no_grad():
        model.parameters["optical_depth"][:] = 0.05
        model.parameters["log_gain"][0] = 2 * settings.gain_std
        model.parameters["shift"][1, 0] = 3 * settings.shift_std * dataset.grid.cell_m
        model.parameters["ground_texture"][5] = 4 * ground.std
        level = model.config.initial_scattering  # of every Gaussian, all around
        model.parameters["scattering"][7, 3] = 5 * model.config.directional_std * level
    grid, count = dataset.grid, len(dataset.select("train"))
    samples = count * grid.rows * grid.columns * np.prod(grid.spacing_m) / np.prod(grid.resolution_m)
    with torch.no_grad():
        actual = float(model.penalty()) * samples
    assert actual == pytest.approx((2**2 + 3**2 + 4**2 + 5**2) / 2 + 20 * 0.3 * np.log(2), rel=1e-4)


def test_dropped_gaussians_are_made_up_for(dataset: Dataset) -> None:
    model = Trainer(dataset, replace(preset("measured"), gaussians=4, dropout=0.5, initial_optical_depth=0.1)).model
    seen = {}
    for dropped in (None, torch.tensor([True, False, False, True])):
        with torch.no_grad():
            _, rendering = model.render([View(0.0, 30.0)], dataset.grid, 0, dropped=dropped)
        seen[dropped is None] = rendering.cross_sections[0, :4, 0]
    assert seen[False][[0, 3]].tolist() == [0, 0]
    assert bool((seen[False][[1, 2]] > seen[True][[1, 2]]).all())


def test_a_target_larger_than_its_box_is_told(dataset: Dataset, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    config = replace(preset("measured"), gaussians=20)
    for height, fits in ((3.1, True), (10.0, False)):
        mesh = tmp_path / f"{height}.ply"
        trimesh.creation.box(bounds=[[-4, -2, 0], [6, 2, height]]).export(mesh)
        images = replace(dataset, truth_mesh=mesh, target_box_m=((-4.5, -2.5, 0.0), (6.5, 2.5, 3.0)))
        with (
            nullcontext() if fits else pytest.warns(SarsplatWarning, match=r"z 0 … 10 m\) is not all inside of the box")
        ):
            Trainer(images, config)
    trimesh.creation.box(bounds=[[-40, -40, 0], [40, 40, 40]]).export(mesh)
    with pytest.warns(SarsplatWarning, match="cut off; give another `target_box`"):
        Trainer(replace(images, target_box_m=None), config)
    # bounded by the images: no warning
    Trainer(replace(images, target_box_m=None), replace(preset("default"), gaussians=20))
    mesh.write_bytes(b"garbled")
    Trainer(images, config)


def test_folders_of_others_are_left_alone(dataset: Dataset, config: Config, tmp_path: Path, finished: Run) -> None:
    with pytest.raises(SarsplatError, match="exists"):
        reconstruct(dataset, config, finished.path)
    (tmp_path / "config.json").write_text('{"mine": 1}')
    with pytest.raises(SarsplatError, match="its schema is None but this program reads 'sarsplat-run'"):
        Run.load(tmp_path)
    for write in (partial(reconstruct, dataset, config), finished.save):
        with pytest.raises(SarsplatError, match="not the header of a run"):
            write(tmp_path, overwrite=True)
    assert (tmp_path / "config.json").read_text() == '{"mine": 1}'


def test_a_torn_log_is_read_up_to_the_tear(finished: Run, tmp_path: Path) -> None:
    log = (finished.path / "metrics.jsonl").read_text().splitlines()
    copy = replace(finished, path=tmp_path)
    for torn in (log[3][:9], "[" * 10_000):
        (tmp_path / "metrics.jsonl").write_text("\n".join([*log[:3], torn]))
        assert copy.history == finished.history[:3]
    (tmp_path / "metrics.jsonl").write_text(f"{log[0]}\n" * 70_000)
    with pytest.raises(SarsplatError, match=r"metrics\.jsonl is longer than 4194304 bytes"):
        _ = copy.history


def test_a_given_box_is_where_a_target_is_looked_for(dataset: Dataset) -> None:
    config = replace(preset("measured"), gaussians=20)
    assert dataset.target_box_m is None
    train = dataset.select("train")
    region, (low, high) = SceneFrame.of(config, dataset).region, target_box(train.power, train.views, train.grid)
    assert (region.low.tolist(), region.high.tolist()) == (low.tolist(), high.tolist())
    given = replace(dataset, target_box_m=((-1.0, -2.0, 0.0), (3.0, 4.0, 5.0)))
    assert SceneFrame.of(config, given).region.high.tolist() == [3.0, 4.0, 5.0]
    assert SceneFrame.of(preset("default"), given).region.high.tolist() == [3.0, 4.0, 5.0]


# ---- number of threads -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("slow", "quickest"), [({1: 4, 2: 2, 4: 1}, 4), ({1: 1, 2: 9, 4: 20}, 1), ({1: 2, 2: 1, 4: 4}, 2)]
)
def test_the_quickest_threads(
    slow: dict[int, int], quickest: int, threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    threads(4)
    clock = iter(range(10**6))
    now = 0.0

    def step() -> int:
        nonlocal now
        now += slow[torch.get_num_threads()]
        return next(clock)

    monkeypatch.setattr(training_loop.time, "perf_counter", lambda: now)
    with ThreadChoice("cpu") as choice:
        made = [choice.step(step) for _ in range(20)]
        assert torch.get_num_threads() == quickest
    assert made == list(range(20))
    assert torch.get_num_threads() == 4


@pytest.mark.parametrize(("device", "count"), [("cuda:0", 4), ("cpu", 1)])
def test_a_gpu_and_one_thread_are_left_alone(device: str, count: int, threads: Callable[[int], None]) -> None:
    threads(count)
    with ThreadChoice(device) as choice:
        assert [choice.step(torch.get_num_threads) for _ in range(5)] == [count] * 5
