"""Reconstruction by tiles: the whole scene on coarse images, then tile after tile, and no seams."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from made import FEW_POINTS, dataset_of, upright
from made_runs import assert_same
from sarsplat import Config, Dataset, Gaussians, ImageGrid, RayGrid, Run, SarsplatError, View, preset, reconstruct
from sarsplat.data import read_dataset, write_dataset
from sarsplat.executors import EXECUTORS, Means, executor_ray
from sarsplat.gaussians.ground import Ground
from sarsplat.learning.image_windows import Windows
from sarsplat.learning.observations.single_images import Tile, tiles_of
from sarsplat.renderer import render
from sarsplat.runs.tiled_training import TILE, TileEnd, TileJob
from sarsplat.settings.sections import Densification, Surroundings

GRID = ImageGrid(48, 56, (0.3, 0.3), (0.45, 0.45))
VIEWS = [View(azimuth, grazing) for azimuth in range(0, 360, 60) for grazing in (20.0, 50.0)]
SIDES = (13.0, 9.0, 1.5)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """A low, wide box, as ray casting shows it."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    from sarsplat import ScatteringLaw, simulate_raycast

    box = trimesh.creation.box(SIDES).apply_translation([0, 0, SIDES[2] / 2])
    images = np.stack([simulate_raycast(box, view, GRID, ScatteringLaw()) for view in VIEWS])
    return dataset_of(GRID, [(view, "train") for view in VIEWS], images)


@pytest.fixture(scope="module")
def config() -> Config:
    return replace(preset("quick"), iterations=24, gaussians=400, tiles=2, checkpoint_every=12, points=FEW_POINTS)


@pytest.fixture(scope="module")
def finished(dataset: Dataset, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return reconstruct(dataset, config, tmp_path_factory.mktemp("tiled") / "run", quiet=True)


def test_nothing_is_lost_or_doubled_at_the_seams(finished: Run, dataset: Dataset, config: Config) -> None:
    """Tiles meet near the middle, in the shape of a cross: there is as much as where the whole is learned at once."""
    whole = reconstruct(dataset, replace(config, tiles=1), quiet=True)
    assert finished.iteration == whole.iteration == 24
    rendered, expected = (run.render(VIEWS) ** 0.5 for run in (finished, whole))
    truth = dataset.power**0.5
    assert ((rendered - truth) ** 2).mean() < 1.1 * ((expected - truth) ** 2).mean()
    assert abs(len(finished.gaussians) / len(whole.gaussians) - 1) < 0.2
    everywhere, there = (held(finished, width_m) / held(whole, width_m) for width_m in (np.inf, 0.6))
    assert 0.8 < everywhere < 1.25
    assert 0.8 < there < 1.25


def held(run: Run, width_m: float) -> float:
    """What Gaussians there are so near to the axes, by the area that each would shade, m²."""
    scene = run.gaussians
    near = scene.means[:, :2].abs().amin(1) < width_m
    areas = scene.scales.sort(dim=1).values[:, 1:].prod(1)
    return float((scene.optical_depth * areas)[near].sum())


def test_a_stopped_one_resumes_to_the_bit(finished: Run, dataset: Dataset, config: Config, tmp_path: Path) -> None:
    out, steps = tmp_path / "run", []

    def stop(step: Any) -> None:
        steps.append(step.iteration)
        if len(steps) in (6, 27, 28, 39):  # of the whole; of the second tile, twice; of the last one
            raise RuntimeError("stopped")

    for _ in range(4):
        with pytest.raises(RuntimeError, match="stopped"):
            reconstruct(dataset, config, out, on_step=stop, quiet=True, resume=out.exists())
    assert steps.count(24) == 3  # finished tiles are kept
    assert (out / "tiles").is_dir()
    resumed = reconstruct(dataset, config, out, quiet=True, resume=True)
    assert_same(resumed.snapshot, finished.snapshot)
    np.testing.assert_array_equal(resumed.points, finished.points)
    assert not (out / "tiles").exists()
    assert [line.iteration for line in resumed.history][-1] == 24


def test_threads_and_folders_make_no_difference(finished: Run, dataset: Dataset, config: Config, threads: Any) -> None:
    threads(3 if torch.get_num_threads() == 1 else 1)
    assert_same(reconstruct(dataset, config, quiet=True).snapshot, finished.snapshot)


def test_its_points_are_extracted_anew(finished: Run, dataset: Dataset, config: Config) -> None:
    coarser = replace(config, points=replace(FEW_POINTS, voxel=1.0))
    again = reconstruct(dataset, coarser, finished.path, resume=True, quiet=True)
    assert 0 < len(again.points) < len(finished.points)
    reconstruct(dataset, config, finished.path, resume=True, quiet=True)


@pytest.mark.parametrize("tiles", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_more_iterations_make_no_more_gaussians(dataset: Dataset, config: Config, tiles: int, tmp_path: Path) -> None:
    """Though the levels of a longer training begin again."""
    how, out = replace(config, tiles=tiles), tmp_path / "run"
    counts = [
        len(reconstruct(dataset, replace(how, iterations=n), out, quiet=True, resume=out.exists()).gaussians)
        for n in (24, 40, 60)
    ]
    assert max(counts) <= counts[0] * 1.02
    assert counts[-1] > 0.9 * counts[0]


# ---- tiles that others learn -----------------------------------------------------------------------------------------
Ends = Iterator[tuple[TileJob, TileEnd | None]]


@pytest.fixture
def stored(dataset: Dataset, tmp_path: Path) -> Dataset:
    write_dataset(tmp_path / "data", dataset)
    return read_dataset(tmp_path / "data")


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., Ends]], str]:
    """Makes an executor of a function; returns its name."""
    monkeypatch.setitem(EXECUTORS._entries, "made", None)
    return lambda do: monkeypatch.setitem(EXECUTORS._loaded, "made", do) or "made"


def here(jobs: Sequence[TileJob], out: Path, means: Means) -> Ends:
    """One after the other in this process, the last one first, as if in another."""
    before = torch.get_num_threads()
    for job in reversed(jobs):
        yield job, TILE.do(job, out, means.again)
        torch.set_num_threads(before)


@pytest.mark.slow
def test_processes_make_the_same_bits(
    finished: Run, stored: Dataset, config: Config, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sarsplat.progress._SECONDS_BETWEEN_LINES", 0.0)
    run = reconstruct(stored, config, tmp_path / "run", executor="local", means=Means(processes=2))
    assert_same(run.snapshot, finished.snapshot)
    np.testing.assert_array_equal(run.points, finished.points)
    assert run.history[-1].iteration == 24
    assert not (tmp_path / "run" / "tiles").exists()
    assert "4 tiles, by other processes" in capsys.readouterr().out


def test_a_cluster_makes_the_same_bits(
    finished: Run, stored: Dataset, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a stand-in for Ray, which does everything in this process, but in another folder.

    The last step that is told is marked: from then on, Ctrl-C does not wait for the end of one.
    """
    monkeypatch.chdir(tmp_path)
    near, elsewhere = read_dataset(stored.path.relative_to(tmp_path)), tmp_path / "elsewhere"
    elsewhere.mkdir()

    class Task:
        def __init__(self, *arguments: Any) -> None:
            threads = torch.get_num_threads()
            os.chdir(elsewhere)
            self.result = executor_ray._do(*arguments)
            os.chdir(tmp_path)
            torch.set_num_threads(threads)

    ray: Any = ModuleType("ray")
    ray.is_initialized, ray.cluster_resources = lambda: True, dict
    ray.remote = lambda do: SimpleNamespace(options=lambda **given: SimpleNamespace(remote=Task))
    ray.wait, ray.get = lambda tasks, num_returns: (tasks[:1], tasks[1:]), lambda task: task.result
    ray.cancel = lambda task, force: None
    monkeypatch.setitem(sys.modules, "ray", ray)
    steps: list[tuple[int, bool]] = []
    run = reconstruct(
        near, config, "run", executor="ray", on_step=lambda at: steps.append((at.iteration, at.last)), quiet=True
    )
    assert_same(run.snapshot, finished.snapshot)
    assert [last for _, last in steps] == [False] * (len(steps) - 1) + [True]
    assert steps[-1][0] < 24


def test_tiles_go_on_whoever_began(
    finished: Run, stored: Dataset, config: Config, tmp_path: Path, executor: Any
) -> None:
    """Stopped while others learn tiles, after one of them; then in this process, and then by others again."""
    out, asked, steps = tmp_path / "run", [], []

    def stopped(jobs: Sequence[TileJob], folder: Path, means: Means) -> Ends:
        asked.extend(job.number for job in jobs)
        yield next(here(jobs, folder, means))
        raise KeyboardInterrupt

    def stop(step: Any) -> None:
        steps.append((step.iteration, step.last))
        if len(steps) == 5:
            raise RuntimeError("stopped")

    with pytest.raises(KeyboardInterrupt):
        reconstruct(stored, config, out, executor=executor(stopped), quiet=True)
    assert asked == [0, 1, 2, 3]
    with pytest.raises(RuntimeError, match="stopped"):
        reconstruct(stored, config, out, on_step=stop, quiet=True, resume=True)
    assert steps[0][0] > 1  # the whole is not learned again
    run = reconstruct(stored, config, out, executor=executor(here), quiet=True, resume=True)
    assert_same(run.snapshot, finished.snapshot)


def test_an_unfinished_tile_is_one_sentence(stored: Dataset, config: Config, tmp_path: Path, executor: Any) -> None:
    out, end = tmp_path / "run", TileEnd("its process ended with code 3; resume it")
    (tmp_path / "data" / "images").rename(tmp_path / "data" / "elsewhere")
    for do, words in (
        (lambda jobs, *_: (one for one in [(jobs[2], end)]), "tile 3 of 4 was not finished: its process ended with"),
        (lambda jobs, *_: (one for one in [(jobs[0], None)]), "tile 1 of 4 was not finished: another process"),
        (here, "tile 4 of 4 was not finished: .*images"),
    ):
        with pytest.raises(SarsplatError, match=f"^{words}"):
            reconstruct(stored, config, out, executor=executor(do), quiet=True, resume=out.exists())


NEEDS = "executor is local, which needs tiles above 1, the dataset's folder, out"


@pytest.mark.parametrize(
    ("changes", "given", "message"),
    [
        ({}, {"executor": "lokal"}, "executor .lokal. is unknown; did you mean local"),
        ({"tiles": 1}, {"executor": "local"}, NEEDS),
        ({}, {"executor": "local", "out": None}, NEEDS),
        ({}, {"executor": "local", "loss": lambda a, b: (a - b).abs().mean()}, NEEDS),
        ({"tiles": 0}, {}, "tiles.* 1"),
        ({"tiles": 3}, {}, "tiles is 3, .* blocks of 2 × 2 pixels, by the scene's size; give tiles from 1 to 2"),
        ({"tiles": 9, "coarsest": 2}, {}, "by the setting coarsest"),
        ({"surroundings": Surroundings()}, {}, "surroundings is on, which cannot be combined with tiles 2"),
        ({"densification": Densification()}, {}, "densification is on, which cannot be combined with tiles 2"),
    ],
)
def test_refusals(
    stored: Dataset, config: Config, tmp_path: Path, changes: dict[str, Any], given: dict[str, Any], message: str
) -> None:
    with pytest.raises(SarsplatError, match=message):
        reconstruct(stored, replace(config, **changes), **{"out": tmp_path / "run", "quiet": True, **given})
    assert not (tmp_path / "run").exists()


# ---- tiles and windows -----------------------------------------------------------------------------------------------
def some(count: int, seed: int = 0) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)
    places = (torch.rand(count, 3, generator=draw) - 0.5) * torch.tensor([16.0, 16.0, 0.0])
    places[:, 2] = 3 * torch.rand(count, generator=draw)
    depth, gamma0 = 3 * torch.rand(count, generator=draw), torch.rand(count, 1, generator=draw)
    return upright(places, 0.1 + 0.2 * torch.rand(count, 3, generator=draw), depth, gamma0)


@pytest.mark.parametrize("ground", [None, Ground(torch.tensor(0.1))])
def test_windows_show_what_whole_images_show_there(ground: Ground | None) -> None:
    """With all that shades it or lies over it, though only some Gaussians are rendered."""
    scene, rays = some(400), RayGrid.for_image(GRID)
    views = [View(20, 15), View(100, 45), View(200, 75)]
    own = Tile((1.0, -4.0), (5.0, 0.0)).holds(scene.means)
    windows = Windows.around(scene[own.nonzero()[:, 0]], views, GRID, 0.3, 4)
    needed = windows.shown(scene, views, rays, ground, 0.0)
    assert own.sum() < needed.sum() < len(scene)
    whole = render(scene, views, GRID, rays=rays, ground=ground).images
    order, options = [2, 0], {"rays": rays, "ground": ground, "amplitudes": None, "shift": None}
    few = [views[k] for k in order]
    part = windows.render(scene[needed.nonzero()[:, 0]], few, windows.stack, order, **options)
    expected = windows.of(whole[:, 0])[order]
    assert expected.shape[1:] != whole.shape[2:]
    assert len({(grid.rows, grid.columns) for grid in windows.grids}) > 1
    assert all(side.start % 4 == 0 == side.stop % 4 for side in (*windows.rows, *windows.columns))
    torch.testing.assert_close(part.images[:, 0], expected, rtol=0, atol=1e-4 * float(whole.max()))
    assert part.cross_sections.shape[:2] == (2, int(needed.sum()))


def test_an_image_that_does_not_show_a_tile_has_a_window_at_its_edge() -> None:
    small = replace(GRID, rows=16, columns=16)
    windows = Windows.around(some(50), [View(0, 45), View(90, 45)], replace(small, center_m=(40.0, 0.0)), 0.3, 2)
    assert all(0 <= side.start < side.stop <= 16 for side in (*windows.rows, *windows.columns))


def test_tiles_hold_everything_once_and_alike() -> None:
    means = some(1000).means
    tiles = tiles_of(means, 3)
    held = torch.stack([tile.holds(means) for tile in tiles])
    assert len(tiles) == 9
    assert (held.sum(0) == 1).all()
    assert set(held.sum(1).tolist()) <= {110, 111, 112}
    assert len(tiles_of(torch.zeros(5, 3), 3)) == 1  # nothing to divide
