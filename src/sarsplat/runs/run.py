"""`Run`: results of a training with their storage (folder or memory) and dataset."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from sarsplat.arguments import checks_arguments
from sarsplat.data import (
    Dataset,
    new_folder,
    read_dataset,
    read_json,
    write_bytes,
    write_gaussians_ply,
    write_json,
    write_points_ply,
)
from sarsplat.data.dataset_folder import HEADER as DATASET_HEADER
from sarsplat.data.folders import only_writer
from sarsplat.data.header import place_header
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, Place, View
from sarsplat.learning.device_choice import device_named
from sarsplat.progress import progress
from sarsplat.runs.methods import method_named
from sarsplat.runs.own_gaussians import own_scene
from sarsplat.runs.result import Result
from sarsplat.runs.run_folder import (
    ABOUT,
    HEADER,
    POINTS,
    SCHEMA,
    SCHEMA_VERSION,
    Header,
    InMemory,
    LogLine,
    Metrics,
    RunFolder,
    TrainingState,
    log_text,
    read_header,
    require_replaceable,
)
from sarsplat.settings.config import DEFAULT_METHOD
from sarsplat.threads import convert


@dataclass(frozen=True)
class Run(Result):
    """A reconstruction: images, points, normals and a mesh from its checkpoint, without its dataset.

    Parameters
    ----------
    method : str
        Name of its method, one of `METHODS`.
    config : AnyConfig
        Settings of that method.
    fingerprint : str
        Fingerprint of its dataset when training began.
    path : Path or None
        Its folder: `config.json`, `metrics.jsonl`, `metrics.json`, `checkpoints/`, `points.ply`, `report/` and files of
        its method. None in memory.
    dataset_path : Path or None
        Folder of its dataset.
    memory : InMemory or None
        Its storage without a folder.
    device : str
        Device that renders and extracts points, "cpu" or "cuda"; results are arrays on the CPU.
    images : Dataset or None
        Its dataset in memory.
    trained_on : str
        Device of its training, "cpu" or "cuda"; "" if unknown.
    place : Place or None
        Georeference of the scene's origin from its dataset.
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

    # ---- its dataset -------------------------------------------------------------------------------------------------
    @cached_property
    def target(self) -> str:
        """Target of its dataset; "" if unknown."""
        if self.images is not None:
            return self.images.target
        if self.path is not None and (self.path / HEADER).is_file() and (known := read_header(self.path).target):
            return known
        made_from = None if self.dataset_path is None else self.dataset_path / DATASET_HEADER
        return str(read_json(made_from, dict[str, Any]).get("target", "")) if made_from and made_from.is_file() else ""

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset of its training; raises a SarsplatError if it is missing or has changed."""
        if self.images is not None:
            return self.images
        if self.dataset_path is None:
            raise SarsplatError(
                f"{self.path or 'this run'} has no dataset, or was made from images in memory; give them with "
                "Run.load(…, dataset=…) or Run.from_gaussians(…, dataset=…)"
            )
        if not self.dataset_path.exists():
            raise SarsplatError(
                f"{self.path} needs its dataset, which is no longer at {self.dataset_path}; give it with "
                f"`sarsplat evaluate {self.path} --dataset DIR` or Run.load(…, dataset=…), or resume the run with it"
            )
        dataset = read_dataset(self.dataset_path)
        if dataset.fingerprint() != self.fingerprint:
            raise SarsplatError(
                f"the dataset {self.dataset_path} has changed since {self.path} was made from it; reconstruct again"
            )
        return dataset

    @checks_arguments
    def views_of(self, dataset: Dataset) -> tuple[View, ...]:
        """Return the views of images of its dataset with the corrections of passes that the training learned."""
        if not any(entry.turn is not None for entry in dataset.entries):
            return dataset.views
        return self.reconstruction.views_of(dataset.entries, self.dataset.select("train"))

    # ---- its folder -------------------------------------------------------------------------------------------------
    @classmethod
    @checks_arguments
    def load(cls, path: str | Path, device: str = "cpu", dataset: Dataset | None = None) -> "Run":
        """Read a run's folder.

        Parameters
        ----------
        path : str or Path
            The folder.
        device : {"auto", "cpu", "cuda"}
            Device that renders; "auto" is the best available.
        dataset : Dataset, optional
            Its dataset, if that was in memory or has moved.

        Raises
        ------
        SarsplatError
            If it is missing or not a run of this version, method or device are unavailable, or it was made from another
            dataset.
        """
        path = Path(path)
        header = read_header(path)
        try:
            method = method_named(header.method)
        except SarsplatError as error:
            raise SarsplatError(f"{path / HEADER}: {error}") from error
        config = method.settings.of_run(header.config, str(path / HEADER))
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
    ) -> "Run":
        """Make an in-memory run of Gaussians from a custom training loop or a file.

        Parameters
        ----------
        gaussians : Gaussians
            Gaussians of the target; copied.
        grid : ImageGrid, optional
            Pixels and resolution of its images, which also scale the spacing of points and mesh; by default the
            dataset's, or else 128 × 128 pixels that show all Gaussians.
        views : sequence of View, optional
            Views of its images, which see its points and mesh; by default the dataset's training views, or else 24
            views from all sides.
        dataset : Dataset, optional
            Its training images, for scores and report.
        time_s : float
            Training time, s.
        device : {"auto", "cpu", "cuda"}
            Device that renders.

        Returns
        -------
        Run
            Its `config` has the preset "own loop" with the number and scattering of the Gaussians; other settings,
            `iterations` included, are placeholders.

        Raises
        ------
        SarsplatError
            If there are no Gaussians or no views, or the law of scattering is not registered.
        """
        brightest = None
        if dataset is not None:
            train = dataset.select("train")
            grid, views, brightest = grid or train.grid, views or train.views, float(train.power.max())
        config, snapshot = own_scene(gaussians, grid, views, brightest, time_s)
        where = None if dataset is None or dataset.path is None else dataset.path.resolve()
        fingerprint = "" if dataset is None else dataset.fingerprint()
        held, on = InMemory(snapshot, []), device_named(device).type
        place = None if dataset is None else dataset.place
        return cls(DEFAULT_METHOD, config, fingerprint, None, where, held, on, dataset, place=place)

    @checks_arguments
    def save(self, path: str | Path, *, overwrite: bool = False, quiet: bool = False) -> "Run":
        """Write the run with its scores to a folder, for every command.

        Points that exist, in its folder or in memory, are not extracted again.

        Parameters
        ----------
        path : str or Path
            The folder; it appears when complete.
        overwrite : bool
            Replace an existing run.
        quiet : bool
            Show no progress of the extraction of points, which may take longer than the training.

        Returns
        -------
        Run
            The run in that folder; it can be resumed.

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
            if self.path is not None and self.state.has_results:
                for name, content in RunFolder(self.path).results().items():
                    write_bytes(folder / name, content)
            else:
                vars(copy).update({name: vars(self)[name] for name in ("points", "normals") if name in vars(self)})
                with progress("extracting the surface", 1, quiet) as shown:
                    copy.write_results()
                    shown.advance(1, "points and normals")
            if self.metrics is not None:
                files.keep(self.metrics)
        return replace(self, path=path, memory=None)

    @property
    def state(self) -> TrainingState:
        """Progress of its training."""
        if self.memory is None:
            return RunFolder(self.folder).state
        planned = getattr(self.config, "iterations", self.iteration)
        return TrainingState(self.iteration, planned, has_results=True)

    @property
    def history(self) -> list[LogLine]:
        """Lines of the training's log (`metrics.jsonl`)."""
        return list(self.store.history)

    @property
    def metrics(self) -> Metrics | None:
        """Scores of the last evaluation; None before."""
        return self.store.metrics

    @checks_arguments
    def keep(self, metrics: dict[str, Any]) -> None:
        """Store the scores that `evaluate_run` returned; raise a SarsplatError if they are something else."""
        try:
            scores = convert(metrics, Metrics)
        except msgspec.ValidationError as error:
            raise SarsplatError(f"metrics are no scores of a run ({error}); give those of evaluate_run") from error
        self.store.keep(scores)

    def write_header(self) -> None:
        """Write `config.json`."""
        where = None if self.dataset_path is None else str(self.dataset_path)
        settings = self.config.as_dict()
        made = self.fingerprint, settings, self.method, self.target, self.trained_on
        header = Header(SCHEMA, SCHEMA_VERSION, where, *made, place_header(self.place))
        write_json(self.folder / HEADER, header)

    def write_results(self) -> None:
        """Write `points.ply`, `about.json` and files of its method, for other programs."""
        self.reconstruction.write(self.folder)
        if (gaussians := self.gaussians) is not None:
            write_gaussians_ply(self.folder / "gaussians.ply", gaussians)
        write_json(self.folder / ABOUT, self.about)
        write_points_ply(self.folder / POINTS, self.points, normals=self.normals)
