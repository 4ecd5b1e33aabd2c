"""The folder of a reconstruction: what is in it, and how it is read back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sarsplat.data import (
    Dataset,
    load_checkpoint,
    read_dataset,
    read_json,
    read_points_ply,
    write_gaussians_ply,
    write_json,
    write_points_ply,
)
from sarsplat.data.fields import shown
from sarsplat.data.files import open_file, plain_os_errors
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import RayGrid, View
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.model import SceneModel, power_unit, scene_region
from sarsplat.reconstruction.points import extract_points

SCHEMA = "sarsplat-run"
SCHEMA_VERSION = 1
HEADER = "config.json"

_RESULTS = ("gaussians.ply", "points.ply", "metrics.json", "report/index.html")
"""What is made from the newest checkpoint."""

_EVALUATION_RAYS_PER_PIXEL = 4.0

# What files may say of a training: far more than any does, and what sums and pictures of them can bear.
_MOST = 10**9  # iterations, Gaussians
_LONGEST_S = 1e10
_LARGEST_LOSS = 1e30
_LONGEST_LOG = 1 << 22  # bytes; a training writes some tens of thousands


@dataclass(frozen=True)
class Run:
    """A reconstruction on the disk.

    Parameters
    ----------
    path : Path
        Its folder: `config.json`, `metrics.jsonl`, `metrics.json`, `checkpoints/`, `gaussians.ply`, `points.ply`,
        `report/`.
    dataset_path : Path
        The dataset it was made from.
    fingerprint : str
        That dataset's fingerprint when training began.
    config : Config
        How it was made.
    """

    path: Path
    dataset_path: Path
    fingerprint: str
    config: Config

    @classmethod
    def create(cls, path: Path, dataset: Dataset, config: Config) -> Run:
        """Write `config.json` into a new folder."""
        run = cls(Path(path), dataset.path.resolve(), dataset.fingerprint(), config)
        (run.path / "checkpoints").mkdir()
        run._write_header()
        return run

    def set_dataset_path(self, dataset_path: Path) -> None:
        """Note on the disk where the dataset is now, if it has moved."""
        moved = replace(self, dataset_path=dataset_path.resolve())
        if moved != self:
            moved._write_header()

    def _write_header(self) -> None:
        header = {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "dataset": str(self.dataset_path),
            "dataset_fingerprint": self.fingerprint,
            "config": self.config.as_dict(),
        }
        write_json(self.path / HEADER, header)

    @classmethod
    def load(cls, path: Path) -> Run:
        """Read a run's folder.

        Raises
        ------
        SarsplatError
            If it is missing, or not a run of this version.
        """
        path = Path(path)
        header = path / HEADER
        if not header.is_file():
            what = "does not exist" if not path.exists() else f"holds no {HEADER}, so it is not a run"
            raise SarsplatError(f"{path} {what}; make one with `sarsplat reconstruct DATASET --out {path}`")
        data = read_json(header)
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            raise SarsplatError(
                f"{header} is not the header of a run; give the folder that `sarsplat reconstruct` wrote"
            )
        if data.get("schema_version") != SCHEMA_VERSION:
            raise SarsplatError(
                f"{path} has schema version {shown(data.get('schema_version'))} "
                f"but this program reads {SCHEMA_VERSION}; reconstruct it again"
            )
        if not isinstance(data.get("dataset"), str) or not isinstance(data.get("dataset_fingerprint"), str):
            raise SarsplatError(f"{header} does not name its dataset; reconstruct it again")
        config = Config.from_dict(data.get("config"), str(header))
        return cls(path, Path(data["dataset"]), data["dataset_fingerprint"], config)

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset it was made from."""
        if not self.dataset_path.exists():
            raise SarsplatError(
                f"{self.path} needs the dataset it was made from, which is no longer at {self.dataset_path}; "
                f"say where it is with `sarsplat reconstruct DATASET --out {self.path} --resume`"
            )
        dataset = read_dataset(self.dataset_path)
        if dataset.fingerprint() != self.fingerprint:
            raise SarsplatError(
                f"the dataset {self.dataset_path} is not what {self.path} was made from: it has changed since; "
                "reconstruct again"
            )
        return dataset

    @property
    def checkpoint_path(self) -> Path | None:
        """The newest checkpoint, if there is one."""
        found = sorted((self.path / "checkpoints").glob("*.safetensors"))
        return found[-1] if found else None

    @cached_property
    def checkpoint(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Tensors and state of the newest checkpoint; `iteration` and `seconds` are numbers a training can reach."""
        if self.checkpoint_path is None:
            raise SarsplatError(f"{self.path} holds no checkpoint; run `sarsplat reconstruct` again with --overwrite")
        tensors, state = load_checkpoint(self.checkpoint_path)
        try:
            _count(state.get("iteration"))
            _number(state.get("seconds"), 0.0, _LONGEST_S)
        except ValueError as error:
            raise SarsplatError(
                f"{self.checkpoint_path} does not say how far the training was ({error}); "
                "reconstruct it again with --overwrite"
            ) from error
        return tensors, state

    @cached_property
    def model(self) -> SceneModel:
        """The learned scene, as of the newest checkpoint."""
        tensors, _ = self.checkpoint
        learned = {name.removeprefix("model/"): t for name, t in tensors.items() if name.startswith("model/")}
        region, unit = scene_region(self.config, self.dataset), power_unit(self.config, self.dataset)
        try:
            model = SceneModel(self.config, region, unit, learned)
            model.scene(self.config.harmonics_degree)  # shapes and values are checked where they are used
        except (KeyError, ValueError, TypeError, IndexError, RuntimeError, SarsplatError) as error:
            raise SarsplatError(
                f"{self.checkpoint_path} does not hold a whole model ({shown(str(error))}); "
                "reconstruct it again with --overwrite"
            ) from error
        return model

    @property
    def iteration(self) -> int:
        """Iterations done, as of the newest checkpoint."""
        return int(self.checkpoint[1]["iteration"])

    @property
    def time_s(self) -> float:
        """Training time so far, s of wall clock."""
        return float(self.checkpoint[1]["seconds"])

    @property
    def seed(self) -> int:
        """Seed of everything random."""
        return self.config.seed

    @property
    def gaussians(self) -> Gaussians:
        """The target's Gaussians."""
        return self.model.target(self.model.degree(self.iteration)).detach()

    @cached_property
    def points(self) -> np.ndarray:
        """The reconstructed surface, as of the newest checkpoint, world frame, m, float32 [P, 3].

        From `points.ply`; extracted anew if a training that was killed has not written it.
        """
        path = self.path / "points.ply"
        return read_points_ply(path)[0] if path.is_file() else self._extracted_points()

    @property
    def log_path(self) -> Path:
        """Its `metrics.jsonl`."""
        return self.path / "metrics.jsonl"

    @property
    def history(self) -> list[dict[str, Any]]:
        """The lines of `metrics.jsonl`, up to the first that a crash has torn; a file of over 4 MiB is refused."""
        path = self.log_path
        if not path.is_file():
            return []
        with open_file(path) as file:
            data = file.read(_LONGEST_LOG + 1)
        if len(data) > _LONGEST_LOG:
            raise SarsplatError(f"{path} is longer than {_LONGEST_LOG} bytes, which no training writes; remove it")
        history: list[dict[str, Any]] = []
        for line in data.decode(errors="replace").splitlines():
            try:
                history.append(_log_line(json.loads(line)))
            except (ValueError, KeyError, TypeError, RecursionError):
                break
        return history

    @property
    def metrics(self) -> dict[str, Any] | None:
        """What `sarsplat evaluate` found, if it was asked."""
        path = self.path / "metrics.json"
        if not path.is_file():
            return None
        metrics = read_json(path)
        if not isinstance(metrics, dict) or not all(isinstance(metrics.get(key), dict) for key in ("images", "points")):
            raise SarsplatError(f"{path} holds no scores; write them again with `sarsplat evaluate {self.path}`")
        return metrics

    def render(self, views: Sequence[View]) -> np.ndarray:
        """β⁰ of unseen views, linear power, float32 [V, rows, columns]; rays at a quarter of the pixel spacing."""
        grid = self.dataset.grid
        rays = RayGrid.for_image(grid, _EVALUATION_RAYS_PER_PIXEL)
        degree = self.model.degree(self.iteration)
        images = []
        with torch.no_grad():
            for first in range(0, len(views), 8):  # a few at a time: memory stays small
                images.append(self.model.render(views[first : first + 8], grid, degree, rays=rays)[0].numpy())
        return np.concatenate(images)

    def write_results(self) -> None:
        """Write `gaussians.ply` and `points.ply` from the newest checkpoint."""
        write_gaussians_ply(self.path / "gaussians.ply", self.gaussians)
        write_points_ply(self.path / "points.ply", self._extracted_points())

    def remove_results(self) -> None:
        """Before training goes on: results of an earlier state must not be taken for those of the next checkpoint."""
        with plain_os_errors("write", self.path):
            for name in _RESULTS:
                (self.path / name).unlink(missing_ok=True)

    def _extracted_points(self) -> np.ndarray:
        views = [item.view for item in self.dataset.select("train")]
        points = extract_points(self.gaussians, views, self.dataset.grid, self.config.points)
        return points.astype(np.float32)  # as the file has them


def _log_line(record: dict[str, Any]) -> dict[str, Any]:
    return {
        "iteration": _count(record["iteration"]),
        "seconds": _number(record["seconds"], 0.0, _LONGEST_S),
        "loss": _number(record["loss"], -_LARGEST_LOSS, _LARGEST_LOSS),
        "gaussians": _count(record["gaussians"]),
    }


def _count(value: object) -> int:
    if type(value) is not int or not 0 <= value <= _MOST:
        raise ValueError(f"{shown(value)} is no whole number from 0 to {_MOST}")
    return value


def _number(value: object, least: float, most: float) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{shown(value)} is no number from {least:g} to {most:g}")
    return float(value)


def require_replaceable(out: Path) -> None:
    """Refuse to overwrite a folder that is not a run, of whatever version: many programs keep a `config.json`."""
    header = out / HEADER
    if header.is_file():
        data = read_json(header)
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            raise SarsplatError(f"{header} is not the header of a run, so it is not ours to replace; give another name")
