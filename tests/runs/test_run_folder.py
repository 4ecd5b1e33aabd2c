"""The folder of a run: results fit the checkpoint, an old run is given up late, one process writes."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from programs import elsewhere
from sarsplat import Dataset, Run, SarsplatError, reconstruct
from sarsplat.data import read_dataset
from sarsplat.data.folders import only_writer
from sarsplat.learning import Trainer
from sarsplat.runs import Step
from sarsplat.runs.run_folder import Header, distinguished
from sarsplat.settings import Config


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


def test_results_are_never_older_than_the_checkpoint(
    dataset: Dataset, config: Config, tmp_path: Path, finished: Run, stop_at: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    stop_at(25, ValueError("stopped here"))
    with pytest.raises(ValueError, match="stopped here"):
        reconstruct(dataset, config, out)
    Run.load(out).write_results()  # as of iteration 20
    (out / "metrics.json").write_text("{}")
    early = Run.load(out).points
    stop_at(45, Killed())
    with pytest.raises(Killed):
        reconstruct(dataset, config, out, resume=True)
    killed = Run.load(out)
    assert killed.iteration == 40
    assert sorted(path.name for path in out.iterdir()) == ["checkpoints", "config.json", "metrics.jsonl"]
    assert not np.array_equal(killed.points, early)
    fresh = killed.points
    killed.write_results()
    assert np.array_equal(Run.load(out).points, fresh)  # the file holds the same
    monkeypatch.undo()
    assert np.array_equal(reconstruct(dataset, config, out, resume=True).points, finished.points)


@pytest.mark.parametrize("error", [ValueError(), Killed()])
def test_an_old_run_is_kept_until_the_first_checkpoint(
    dataset: Dataset, config: Config, tmp_path: Path, finished: Run, stop_at: Any, error: BaseException
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished.path, out)
    stop_at(19, error)
    with pytest.raises(type(error)):
        reconstruct(dataset, replace(config, seed=1), out, overwrite=True)
    assert Run.load(out).seed == 0
    assert np.array_equal(Run.load(out).points, finished.points)
    stop_at(20, error)
    with pytest.raises(type(error)):
        reconstruct(dataset, replace(config, seed=1), out, overwrite=True)
    assert (Run.load(out).seed, Run.load(out).iteration) == (1, 20)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_ctrl_c_before_the_first_checkpoint_keeps_an_old_run_and_makes_a_new_one(
    dataset: Dataset, config: Config, tmp_path: Path, finished: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(step: Step) -> None:
        if step.iteration == 3:
            raise KeyboardInterrupt

    shutil.copytree(finished.path, tmp_path / "old")
    with pytest.raises(KeyboardInterrupt, match="old is still as it was"):
        reconstruct(dataset, replace(config, seed=1), tmp_path / "old", on_step=stop, overwrite=True)
    assert (Run.load(tmp_path / "old").seed, Run.load(tmp_path / "old").iteration) == (0, 60)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(dataset, config, tmp_path / "new", on_step=stop)
    assert Run.load(tmp_path / "new").iteration == 3
    assert not (tmp_path / "new" / "points.ply").exists()  # stopping does not wait for the surface
    assert len(Run.load(tmp_path / "new").points)  # which is extracted where it is asked for


def test_it_is_locked_from_its_first_moment_to_its_last(
    dataset: Dataset, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, step, refused = tmp_path / "run", Trainer.step, []

    def probing(trainer: Trainer) -> torch.Tensor:
        if trainer.iteration == 30:
            with pytest.raises(SarsplatError, match="in use"), elsewhere(only_writer(out)):
                pass
            refused.append(out)
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", probing)
    reconstruct(dataset, replace(config, iterations=40), out)
    assert refused == [out]
    with only_writer(out):
        pass


def test_a_dataset_may_move(dataset: Dataset, config: Config, tmp_path: Path, finished: Run) -> None:
    moved, out = tmp_path / "moved", tmp_path / "run"
    shutil.copytree(dataset.path, moved)
    shutil.copytree(finished.path, out)
    header = json.loads((out / "config.json").read_text())
    (out / "config.json").write_text(json.dumps({**header, "dataset": str(tmp_path / "gone")}))
    with pytest.raises(SarsplatError, match=r"no longer at .*/gone; give it with"):
        _ = Run.load(out).dataset
    again = reconstruct(read_dataset(moved), config, out, resume=True)
    assert again.dataset_path == moved
    assert Run.load(out).dataset.fingerprint() == dataset.fingerprint()
    assert torch.equal(again.gaussians.means, finished.gaussians.means)


def test_a_run_of_another_version_can_be_overwritten(dataset: Dataset, config: Config, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"schema": "sarsplat-run", "schema_version": 0}')
    with pytest.raises(SarsplatError, match="reconstruct it again"):
        Run.load(tmp_path)
    assert reconstruct(dataset, replace(config, iterations=2), tmp_path, overwrite=True).iteration == 2


def test_a_full_disk_is_told_in_one_sentence(
    dataset: Dataset, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.open

    def full(self: Path, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if self.name == "metrics.jsonl" and mode == "ab":
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(SarsplatError, match=r"cannot write .*metrics\.jsonl: the disk is full"):
        reconstruct(dataset, config, tmp_path / "run")
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


def test_a_copied_checkpoint_is_none(tmp_path: Path, dataset: Dataset, config: Config, finished: Run) -> None:
    run = Run.load(shutil.copytree(finished.path, tmp_path / "run"))
    newest = run.store.checkpoint_path
    shutil.copy(newest, newest.with_name("best.safetensors"))
    assert run.store.checkpoint_path == newest
    reconstruct(dataset, replace(config, iterations=70), run.path, resume=True, quiet=True)
    assert Run.load(run.path).iteration == 70
    assert newest.with_name("best.safetensors").is_file()


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
    ) == [
        "T72, seed 0",
        "T72, smoothing, dropout 0.1, seed 0",
    ]
