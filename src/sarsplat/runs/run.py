"""A run: what a training has learned, the folder that holds it if there is one, and the dataset it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, new_folder, read_dataset, read_json, write_bytes, write_json, write_points_ply
from sarsplat.data.dataset_folder import HEADER as DATASET_HEADER
from sarsplat.data.folders import only_writer
from sarsplat.data.header import place_header
from sarsplat.errors import SarsplatError, shown
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, Place, View
from sarsplat.learning.device_choice import device_named
from sarsplat.learning.snapshot import Snapshot
from sarsplat.progress import progress
from sarsplat.runs.methods import METHODS, method_named
from sarsplat.runs.own_gaussians import own_scene
from sarsplat.runs.result import Result
from sarsplat.runs.run_folder import (
    ABOUT,
    HEADER,
    METRICS,
    POINTS,
    SCHEMA,
    SCHEMA_VERSION,
    Header,
    LogLine,
    Metrics,
    RunFolder,
    TrainingState,
    log_text,
    read_header,
    require_replaceable,
)
from sarsplat.settings.config import DEFAULT_METHOD
from sarsplat.typed import convert


@dataclass
class InMemory:
    """What a run without a folder holds itself."""

    snapshot: Snapshot
    history: tuple[LogLine, ...]
    metrics: Metrics | None = None
    """The scores of the last evaluation."""


@dataclass(frozen=True)
class Run(Result):
    """A reconstruction: renders, and has points, normals and a mesh, without its dataset.

    Parameters
    ----------
    method : str
        Name of the method that made it, one of `METHODS`.
    config : AnyConfig
        How it was made: settings of that method.
    fingerprint : str
        Fingerprint of its dataset when training began.
    path : Path or None
        Its folder: `config.json`, `metrics.jsonl`, `metrics.json`, `checkpoints/`, `points.ply`, `report/` and what
        else its method writes. None if it is in memory only.
    dataset_path : Path or None
        The dataset it was made from, if that is a folder.
    memory : InMemory or None
        What it holds if it has no folder.
    device : str
        Where it renders and extracts points, "cpu" or "cuda"; results come back as arrays either way.
    images : Dataset or None
        The dataset it was made from, where that is in memory.
    trained_on : str
        The kind of device that it was begun on, "cpu" or "cuda"; "" if that is not known.
    place : Place or None
        Where on earth its scene's origin is, as its dataset said; None if that is not known.
    """

    method: str
    config: Any
    fingerprint: str
    path: Path | None = None
    dataset_path: Path | None = None
    memory: InMemory | None = None
    device: str = "cpu"
    images: Dataset | None = field(default=None, compare=False, repr=False)
    trained_on: str = ""
    place: Place | None = None

    def __repr__(self) -> str:
        where, preset = self.path or "in memory", getattr(self.config, "preset", None)
        return f"Run({where}, {self.method}{f', {preset}' if preset else ''}, seed {self.seed})"

    @cached_property
    def snapshot(self) -> Snapshot:
        """The newest state of its training."""
        if self.memory is not None:
            return self.memory.snapshot
        if (checkpoint := RunFolder(self.folder).checkpoint_path) is None:
            raise SarsplatError(f"{self.path} holds no checkpoint; reconstruct it again with overwrite=True")
        return Snapshot.load(checkpoint)

    @property
    def files(self) -> RunFolder | None:
        """Its folder, file by file; None if it is in memory only."""
        return None if self.path is None else RunFolder(self.path)

    # ---- what it was made from --------------------------------------------------------------------------------------
    @cached_property
    def target(self) -> str:
        """What its dataset shows, as that says; "" if it is not known."""
        if self.images is not None:
            return self.images.target
        if self.path is not None and (self.path / HEADER).is_file() and (known := read_header(self.path).target):
            return known
        made_from = None if self.dataset_path is None else self.dataset_path / DATASET_HEADER
        return str(read_json(made_from, dict[str, Any]).get("target", "")) if made_from and made_from.is_file() else ""

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset it was made from.

        Raises
        ------
        SarsplatError
            If it is no longer there, or has changed since.
        """
        if self.images is not None:
            return self.images
        if self.dataset_path is None and not self.fingerprint:
            raise SarsplatError(
                "this run of one's own Gaussians has no dataset; give it to Run.from_gaussians(…, dataset=…), or to "
                "Run.load(…, dataset=…)"
            )
        if self.dataset_path is None:
            raise SarsplatError(
                f"{self.path} was made from images in memory; give them with Run.load({str(self.path)!r}, "
                f"dataset=…), or write them with write_dataset and `sarsplat reconstruct DATASET --out {self.path} "
                "--resume`"
            )
        if not self.dataset_path.exists():
            raise SarsplatError(
                f"{self.path} needs its dataset, which is no longer at {self.dataset_path}; "
                f"say where it is with `sarsplat evaluate {self.path} --dataset DIR`, in Python with "
                f"Run.load(…, dataset=…), or for good with `sarsplat reconstruct DATASET --out {self.path} --resume`"
            )
        dataset = read_dataset(self.dataset_path)
        if dataset.fingerprint() != self.fingerprint:
            raise SarsplatError(
                f"the dataset {self.dataset_path} is not what {self.path} was made from: it has changed since; "
                "reconstruct again"
            )
        return dataset

    @checks_arguments
    def views_of(self, dataset: Dataset) -> tuple[View, ...]:
        """From where images of a dataset were taken, as far as the training corrected the passes that they are of.

        Parameters
        ----------
        dataset : Dataset
            Images of its own dataset, such as its test images.
        """
        if not any(entry.turn is not None for entry in dataset.entries):
            return dataset.views
        return self.reconstruction.views_of(dataset.entries, self.dataset.select("train"))

    # ---- its folder -------------------------------------------------------------------------------------------------
    @classmethod
    @checks_arguments
    def load(cls, path: str | Path, device: str = "cpu", dataset: Dataset | None = None) -> Run:
        """Read a run's folder.

        Parameters
        ----------
        path : str or Path
            The folder.
        device : {"auto", "cpu", "cuda"}
            Where it renders; "auto" is the best there is.
        dataset : Dataset, optional
            The dataset it was made from, if that was in memory, or is no longer where it was.

        Raises
        ------
        SarsplatError
            If it is missing, or not a run of this version, there is no such method, the device cannot be used, or it
            was made from another dataset.
        """
        path = Path(path)
        header = read_header(path)
        if header.method not in METHODS:
            raise SarsplatError(
                f"{path / HEADER} is of a run by the method {shown(header.method)}; give one by {', '.join(METHODS)}, "
                "or install the package that has this method"
            )
        config = method_named(header.method).settings.of_run(header.config, str(path / HEADER))
        if dataset is not None and header.dataset_fingerprint not in ("", dataset.fingerprint()):
            raise SarsplatError(f"{path} was made from another dataset than {dataset}; give the one it was made from")
        where = None if header.dataset is None else Path(header.dataset)
        on = device_named(device).type
        made_from = header.dataset_fingerprint, path, where
        place = header.place.place if header.place else None
        known: dict[str, Any] = {"images": dataset, "trained_on": header.trained_on, "place": place}
        return cls(header.method, config, *made_from, device=on, **known)

    @classmethod
    @checks_arguments
    def from_gaussians(
        cls,
        gaussians: Gaussians,
        grid: ImageGrid | None = None,
        views: Sequence[View] | None = None,
        *,
        dataset: Dataset | None = None,
        time_s: float = 0.0,
        device: str = "cpu",
    ) -> Run:
        """A run in memory of Gaussians from a loop of one's own or from a file: for viewer, exports, scores and report.

        Parameters
        ----------
        gaussians : Gaussians
            The target alone; copied.
        grid : ImageGrid, optional
            Pixels and resolution of its images; the unit of lengths in points and mesh is its resolution cell. Without
            it the dataset's, or else 128 × 128 pixels that show all Gaussians.
        views : sequence of View, optional
            From where its images were taken: its points and mesh are what these see. Without them the dataset's
            training views, or else 24 views from all sides.
        dataset : Dataset, optional
            The images that it was learned from; scores and report need them.
        time_s : float
            How long that took, s.
        device : {"auto", "cpu", "cuda"}
            Where it renders.

        Returns
        -------
        Run
            Its `config` has the preset "own loop", the number and the scattering of the Gaussians; what else stands
            there, `iterations` among it, says how the Gaussians are held, and nothing of how they were made.

        Raises
        ------
        SarsplatError
            If there are no Gaussians or no views, or the law of scattering is not a registered one.
        """
        brightest = None
        if dataset is not None:
            train = dataset.select("train")
            grid, views, brightest = grid or train.grid, views or train.views, float(train.power.max())
        config, snapshot = own_scene(gaussians, grid, views, brightest, time_s)
        where = None if dataset is None or dataset.path is None else dataset.path.resolve()
        fingerprint = "" if dataset is None else dataset.fingerprint()
        held, on = InMemory(snapshot, ()), device_named(device).type
        place = None if dataset is None else dataset.place
        return cls(DEFAULT_METHOD, config, fingerprint, None, where, held, on, dataset, place=place)

    @checks_arguments
    def save(self, path: str | Path, *, overwrite: bool = False, quiet: bool = False) -> Run:
        """Write the run to a folder, from where every command takes it; with the scores, if it was evaluated.

        Points that it has, in its folder or since they were asked for, are not extracted again.

        Parameters
        ----------
        path : str or Path
            The folder; it appears when it is whole.
        overwrite : bool
            Replace an existing run.
        quiet : bool
            Show no progress of the extraction of points, which may take longer than the training.

        Returns
        -------
        Run
            The run in that folder. A finished training in it can be extended as any other.

        Raises
        ------
        SarsplatError
            If the folder exists, another process is writing it, or the disk is full.
        """
        path = Path(path)
        if overwrite:
            require_replaceable(path)
        with only_writer(path), new_folder(path, overwrite, marker=HEADER) as folder:
            copy, files = replace(self, path=folder, memory=None), RunFolder(folder)
            copy.write_header()
            files.save(self.snapshot)
            write_bytes(files.log_path, log_text(self.history))
            if self.files is not None and self.state.has_results:
                for name, content in self.files.results().items():
                    write_bytes(folder / name, content)
            else:
                vars(copy).update({name: vars(self)[name] for name in ("points", "normals") if name in vars(self)})
                with progress("extracting the surface", 1, quiet) as shown:
                    copy.write_results()
                    shown.advance(1, "points and normals")
            if self.metrics is not None:
                write_json(folder / METRICS, self.metrics)
        return replace(self, path=path, memory=None)

    @property
    def folder(self) -> Path:
        """Where it is on the disk.

        Raises
        ------
        SarsplatError
            If it is in memory only.
        """
        if self.path is None:
            raise SarsplatError("this run is in memory and has no folder; save it first with run.save(PATH)")
        return self.path

    @property
    def state(self) -> TrainingState:
        """How far its training is."""
        if self.files is not None:
            return self.files.state
        planned = getattr(self.config, "iterations", self.iteration)
        return TrainingState(self.iteration, planned, has_results=True)

    @property
    def history(self) -> list[LogLine]:
        """The lines of its log, which its folder has as `metrics.jsonl`."""
        if self.memory is not None:
            return list(self.memory.history)
        return RunFolder(self.folder).history

    @property
    def metrics(self) -> Metrics | None:
        """The scores of the last evaluation; None before."""
        if self.memory is not None:
            return self.memory.metrics
        return None if self.files is None else self.files.metrics

    @checks_arguments
    def keep(self, metrics: dict[str, Any]) -> None:
        """Take these scores, what `evaluate_run` returns, as its last ones; in its folder if it has one.

        Raises
        ------
        SarsplatError
            If they are something else, or another process is writing the run.
        """
        try:
            scores = convert(metrics, Metrics)
        except msgspec.ValidationError as error:
            raise SarsplatError(
                f"these are not the scores of a run ({error}); give what evaluate_run returns"
            ) from error
        if self.files is not None:
            write_json(self.files.path / METRICS, scores)
        elif self.memory is not None:
            self.memory.metrics = scores

    def write_header(self) -> None:
        """Write the `config.json` of its folder."""
        where = None if self.dataset_path is None else str(self.dataset_path)
        settings = self.config.as_dict()
        made = self.fingerprint, settings, self.method, self.target, self.trained_on
        header = Header(SCHEMA, SCHEMA_VERSION, where, *made, place_header(self.place))
        write_json(self.folder / HEADER, header)

    def write_results(self) -> None:
        """Write what other programs read: `points.ply`, `about.json`, and what else its method has."""
        learned = self.reconstruction
        learned.write(self.folder)
        write_json(self.folder / ABOUT, self.about)
        write_points_ply(self.folder / POINTS, self.points, normals=self.normals)
