"""The folder of a run: results fit the checkpoint, one process writes, and it goes on only as it was begun."""

import errno
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from made import dataset_of
from programs import elsewhere
from refusals import edit_json
from sarsplat import Config, Dataset, ImageGrid, Run, SarsplatError, View, preset, read_dataset, reconstruct
from sarsplat.data import load_checkpoint, save_checkpoint, write_dataset, write_tiff
from sarsplat.data.folders import only_writer
from sarsplat.learning import Trainer, scene_frame
from sarsplat.runs import Step
from sarsplat.runs.run_folder import Header, distinguished
from sarsplat.settings.sections import Densification, PointExtraction, Rates, Smoothing


class Killed(BaseException):
    """The end of a process, for which nothing is done any more."""


@pytest.fixture
def stop_at(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Raise something in the step after so many."""
    step = Trainer.step

    def arrange(iteration: int, error: BaseException) -> None:
        def stopping(trainer: Trainer) -> torch.Tensor:
            if trainer.iteration == iteration:
                raise error
            return step(trainer)

        monkeypatch.setattr(Trainer, "step", stopping)

    return arrange


def test_results_fit_the_checkpoint(
    given: Dataset, tmp_path: Path, stop_at: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, config = tmp_path / "run", replace(CONFIG, iterations=6, checkpoint_every=2, points=CENTRES)
    stop_at(3, ValueError("stopped here"))
    with pytest.raises(ValueError, match="stopped here"):
        reconstruct(given, config, out)
    Run.load(out).write_results()  # as of iteration 2
    (out / "metrics.json").write_text("{}")
    early = Run.load(out).points
    stop_at(5, Killed())
    with pytest.raises(Killed):
        reconstruct(given, config, out, resume=True)
    killed = Run.load(out)
    assert killed.iteration == 4
    assert sorted(path.name for path in out.iterdir()) == ["checkpoints", "config.json", "metrics.jsonl"]
    assert not np.array_equal(killed.points, early)
    fresh = killed.points
    killed.write_results()
    assert np.array_equal(Run.load(out).points, fresh)  # the file holds the same
    monkeypatch.undo()
    whole = reconstruct(given, config, quiet=True)
    assert np.array_equal(reconstruct(given, config, out, resume=True).points, whole.points)


@pytest.mark.parametrize("error", [ValueError(), Killed()])
def test_an_old_run_is_kept(given: Dataset, done: Run, tmp_path: Path, stop_at: Any, error: BaseException) -> None:
    out, config = tmp_path / "run", replace(CONFIG, seed=1, iterations=5, checkpoint_every=2)
    before = content(shutil.copytree(done.folder, out))
    for iteration in (1, 2):
        assert content(out) == before
        stop_at(iteration, error)
        with pytest.raises(type(error)):
            reconstruct(given, config, out, overwrite=True)
    assert (Run.load(out).seed, Run.load(out).iteration) == (1, 2)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_ctrl_c_before_the_first_checkpoint(given: Dataset, done: Run, tmp_path: Path) -> None:
    def stop(step: Step) -> None:
        if step.iteration == 3:
            raise KeyboardInterrupt

    config, old = replace(CONFIG, iterations=9, checkpoint_every=9, points=CENTRES), tmp_path / "old"
    before = content(shutil.copytree(done.folder, old))
    with pytest.raises(KeyboardInterrupt, match="old is still as it was"):
        reconstruct(given, config, old, on_step=stop, overwrite=True)
    assert content(old) == before
    with pytest.raises(KeyboardInterrupt):
        reconstruct(given, config, tmp_path / "new", on_step=stop)
    assert Run.load(tmp_path / "new").iteration == 3
    assert not (tmp_path / "new" / "points.ply").exists()  # stopping does not wait for the surface
    assert len(Run.load(tmp_path / "new").points)  # which is extracted where it is asked for


def test_it_is_locked_throughout(given: Dataset, tmp_path: Path) -> None:
    out, refused = tmp_path / "run", []

    def probe(step: Step) -> None:
        with pytest.raises(SarsplatError, match="in use"), elsewhere(only_writer(out)):
            pass
        refused.append(step.iteration)

    reconstruct(given, CONFIG, out, on_step=probe)
    assert refused == [1, 2]
    with only_writer(out):
        pass


def test_a_dataset_may_move(given: Dataset, done: Run, tmp_path: Path) -> None:
    moved = shutil.copytree(given.path, tmp_path / "moved")
    out = shutil.copytree(done.folder, tmp_path / "run")
    edit_json(out / "config.json", "dataset", str(tmp_path / "gone"))
    with pytest.raises(SarsplatError, match=r"no longer at .*/gone; give it with"):
        _ = Run.load(out).dataset
    again = reconstruct(read_dataset(moved), CONFIG, out, resume=True)
    assert again.dataset_path == moved
    assert Run.load(out).dataset.fingerprint() == given.fingerprint()
    assert torch.equal(again.gaussians.means, done.gaussians.means)


def test_a_run_of_another_version_can_be_overwritten(given: Dataset, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"schema": "sarsplat-run", "schema_version": 0}')
    with pytest.raises(SarsplatError, match="reconstruct it again"):
        Run.load(tmp_path)
    assert reconstruct(given, CONFIG, tmp_path, overwrite=True).iteration == 2


def test_a_full_disk_is_named(given: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.open

    def full(self: Path, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if self.name == "metrics.jsonl" and mode == "ab":
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(SarsplatError, match=r"cannot write .*metrics\.jsonl: the disk is full"):
        reconstruct(given, replace(CONFIG, checkpoint_every=2), tmp_path / "run")
    assert Run.load(tmp_path / "run").iteration == 1  # what there was room for


def test_scores_are_kept_as_they_are_and_nothing_else_is(tmp_path: Path, finished: Run) -> None:
    run = Run.load(shutil.copytree(finished.path, tmp_path / "run"))
    scores: dict[str, Any] = {key: {"visible": {"count": 3, "cd_m": 0.25}} for key in ("points", "mesh", "capon")}
    scores |= {key: {} for key in ("images", "parameters", "definitions", "reasons")}
    scores |= {"baselines": None, "time_s": None, "seed": 0}
    run.keep(scores)
    assert run.metrics == scores
    assert run.metrics["points"]["visible"]["count"].__class__ is int
    with pytest.raises(SarsplatError, match="metrics are no scores of a run"):
        run.keep({"a": 1})
    assert run.metrics == scores


# ---- names of runs whose folders are called by addresses -------------------------------------------------------------
def header(dataset: str | None, method: str = "sar-gs", **config: Any) -> Header:
    return Header("sarsplat-run", 4, dataset, "", config, method)


def test_settings_are_named_where_they_differ_between_runs_alike() -> None:
    runs = [
        header("/a/T72", preset="quick", iterations=5, points={"voxel": 0.1, "rays": 2}, seed=0),
        header("/a/T72", preset="quick", iterations=5, points={"voxel": 0.2, "rays": 2}, seed=0),
        header("/a/BMP2", preset="quick", iterations=9, points={"voxel": 0.2, "rays": 2}, seed=1),
    ]
    assert distinguished(runs) == ["T72, points.voxel 0.1, seed 0", "T72, points.voxel 0.2, seed 0", "BMP2, seed 1"]
    others = [header("/a/T72", "sar-nerf-grid", iterations=9, seed=0), header("/b/T72", preset="default", seed=0)]
    assert distinguished([runs[0], *others]) == [
        "/a/T72, sar-gs, quick, seed 0",
        "/a/T72, sar-nerf-grid, seed 0",
        "/b/T72, sar-gs, default, seed 0",
    ]
    assert distinguished([header(None)]) == ["images in memory"]


def test_sections_that_some_do_not_have_are_named() -> None:
    dense, none = {"start": 5, "stop": 9}, header("/a/T72", preset="quick", densification=None, seed=0)
    runs = [header("/a/T72", preset="quick", densification=dense, seed=0), none]
    assert distinguished(runs) == ["T72, densification, seed 0", "T72, densification None, seed 0"]
    other = header("/a/T72", preset="quick", densification={**dense, "stop": 8}, seed=0)
    assert distinguished([*runs, other]) == [
        "T72, densification, densification.stop 9, seed 0",
        "T72, densification None, seed 0",
        "T72, densification, densification.stop 8, seed 0",
    ]
    earlier = header("/a/T72", preset="quick", seed=0)
    assert distinguished(
        [earlier, header("/a/T72", preset="quick", smoothing={"rounds": 40}, dropout=0.1, seed=0)]
    ) == ["T72, seed 0", "T72, smoothing, dropout 0.1, seed 0"]


# ---- another dataset, other settings or another version are refused --------------------------------------------------
CONFIG = replace(preset("default"), iterations=2, gaussians=50, checkpoint_every=1)
CENTRES = PointExtraction(method="centres", optical_depth=0.0, voxel=1e-6, min_height=-1e6)
"""A point for each Gaussian."""


def make_dataset(path: Path, azimuth: float = 0.0) -> Dataset:
    images = np.zeros((3, 16, 16), np.float32)
    images[:, 6:10, 6:10] = np.random.default_rng(0).uniform(0.5, 1, size=(3, 4, 4))
    views = [(View(azimuth + 120.0 * k, 40.0), "train") for k in range(3)]
    grid = ImageGrid(16, 16, (0.3, 0.3), (0.4, 0.4))
    return write_dataset(path, dataset_of(grid, views, images))


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dataset(tmp_path_factory.mktemp("made") / "dataset")


@pytest.fixture(scope="module")
def done(given: Dataset) -> Run:
    return reconstruct(given, CONFIG, given.path.with_name("run"))


@pytest.fixture
def begun(done: Run, tmp_path: Path) -> Path:
    """A run with one step to go."""
    out = shutil.copytree(done.folder, tmp_path / "run")
    Run.load(out).store.checkpoint_path.unlink()
    return out


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(begun: Path, given: Dataset, config: Config, message: str) -> None:
    before = content(begun)
    with pytest.raises(SarsplatError, match=message):
        reconstruct(given, config, begun, resume=True)
    assert content(begun) == before


def test_one_of_before_there_was_smoothing(given: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its settings do not say that it has none, and it goes on without; nor does it say how often it has grown."""
    monkeypatch.setattr(scene_frame, "_MIN_ACROSS", 2)
    unsmoothed = replace(CONFIG, coarsest=2, smoothing=Smoothing(rounds=0, alike=0.0, collective=0.0))
    whole = reconstruct(given, unsmoothed, tmp_path / "run")
    tensors, _ = load_checkpoint(whole.store.checkpoint_path)
    assert "strategy/relocation" in tensors and "strategy/smoothing" not in tensors
    whole.store.checkpoint_path.unlink()
    newest = whole.store.checkpoint_path
    tensors, state = load_checkpoint(newest)
    del tensors["strategy/growth/times"]
    save_checkpoint(newest, tensors, state)
    edit_json(tmp_path / "run" / "config.json", "config.smoothing", KeyError)
    refused(tmp_path / "run", given, replace(CONFIG, coarsest=2), r"started with smoothing\.rounds 0, not 40")
    again = reconstruct(given, Run.load(tmp_path / "run").config, tmp_path / "run", resume=True)
    assert again.config == unsmoothed
    assert torch.equal(again.gaussians.means, whole.gaussians.means)


def test_another_dataset(begun: Path, given: Dataset, tmp_path: Path) -> None:
    """Or the same one, changed in place."""
    refused(begun, make_dataset(tmp_path / "other", azimuth=1e-6), CONFIG, "started with another dataset")
    image = given.images("train")[1].copy()
    image[0, 0] = 1e-30
    changed = shutil.copytree(given.path, tmp_path / "dataset")
    write_tiff(changed / "images/001.tif", image, "changed")
    refused(begun, read_dataset(changed), CONFIG, "started with another dataset")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "started with seed 0, not 1; resume it with the same settings"),
        ({"p_min": 0.031}, "started with p_min 0.03, not 0.031"),
        ({"preset": "mine"}, "started with preset 'default', not 'mine'"),
        ({"rates": Rates(means=0.1)}, r"started with rates\.means 0.15, not 0.1"),
        ({"densification": Densification()}, "started with densification None, not "),
        ({"iterations": 3, "seed": 1}, "started with seed 0, not 1"),
    ],
)
def test_other_settings(begun: Path, given: Dataset, change: dict[str, Any], message: str) -> None:
    refused(begun, given, replace(CONFIG, **change), message)


@pytest.mark.parametrize("steps", [1, 2])
def test_more_iterations_extend_a_run(begun: Path, given: Dataset, steps: int) -> None:
    if steps == 2:
        reconstruct(given, CONFIG, begun, resume=True)
    newest = Run.load(begun).store.checkpoint_path
    copied = Path(shutil.copy(newest, newest.with_name("best.safetensors")))  # which is none
    assert Run.load(begun).store.checkpoint_path == newest
    run = reconstruct(given, replace(CONFIG, iterations=4, checkpoint_every=3), begun, resume=True)
    assert run.iteration == 4
    assert (Run.load(begun).config.iterations, Run.load(begun).config.checkpoint_every) == (4, 3)
    assert [line.iteration for line in run.history] == [1, 2, 3, 4]
    refused(begun, given, replace(CONFIG, iterations=3), "has already done 4 iterations, more than 3")
    assert copied.is_file()


def test_points_are_extracted_anew(given: Dataset, done: Run, tmp_path: Path) -> None:
    out = shutil.copytree(done.folder, tmp_path / "run")
    (out / "metrics.json").write_text("{}")
    again = reconstruct(given, replace(CONFIG, points=CENTRES), out, resume=True)
    assert again.iteration == done.iteration
    assert len(Run.load(out).points) == len(again.gaussians)
    assert not (out / "metrics.json").exists()  # it was of other points


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("schema_version", 5, "schema_version is 5 but this program reads 4"),
        ("schema_version", 3, "schema_version is 3 but .* 4; give a run of this version, or reconstruct it again"),
        ("config.warmth", 1, "config.json: the setting 'warmth' is unknown"),
    ],
)
def test_another_version(begun: Path, given: Dataset, place: str, value: int, message: str) -> None:
    edit_json(begun / "config.json", place, value)
    refused(begun, given, CONFIG, message)


@pytest.mark.parametrize("change", [{"model/optical_depth": None}, {"model/means": torch.empty(0, 3)}])
def test_a_checkpoint_of_another_version(begun: Path, given: Dataset, change: dict[str, Any]) -> None:
    newest = Run.load(begun).store.checkpoint_path
    tensors, state = load_checkpoint(newest)
    save_checkpoint(newest, {name: t for name, t in (tensors | change).items() if t is not None}, state)
    for iterations in (2, 4):
        refused(begun, given, replace(CONFIG, iterations=iterations), "does not match this version")


def test_a_checkpoint_of_bistatic_views(begun: Path) -> None:
    newest = Run.load(begun).store.checkpoint_path
    tensors, state = load_checkpoint(newest)
    views = [{"azimuth_deg": 1.0, "grazing_deg": 30.0, "apart_deg": 20.0}]
    save_checkpoint(newest, tensors, {**state, "views": views})
    with pytest.raises(SarsplatError, match="bistatic views, which are not supported"):
        Run.load(begun).time_s  # noqa: B018


def test_a_run_that_is_not_there(given: Dataset, tmp_path: Path) -> None:
    with pytest.raises(SarsplatError, match="does not exist"):
        reconstruct(given, CONFIG, tmp_path / "nowhere", resume=True)
    shutil.copytree(given.path, tmp_path / "a dataset")
    with pytest.raises(SarsplatError, match="is a dataset, not a run"):
        reconstruct(given, CONFIG, tmp_path / "a dataset", resume=True)
