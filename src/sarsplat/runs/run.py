"""A reconstruction by any method: its state, and the folder that holds it if there is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex64, Complex128, Float32, Float64, Real, UInt8

from sarsplat.arguments import checks_arguments
from sarsplat.data import (
    Dataset,
    new_folder,
    read_dataset,
    read_json,
    read_points_ply,
    write_bytes,
    write_json,
    write_points_ply,
)
from sarsplat.data.dataset_folder import HEADER as DATASET_HEADER
from sarsplat.data.folders import only_writer
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.learning.device import device_named
from sarsplat.learning.method import Reconstruction
from sarsplat.learning.model import SceneModel
from sarsplat.learning.snapshot import Snapshot
from sarsplat.names import Speckle
from sarsplat.runs.log import LogLine, log_text, read_log
from sarsplat.runs.methods import METHODS, method_named
from sarsplat.runs.own_gaussians import own_scene
from sarsplat.runs.run_folder import (
    ABOUT,
    HEADER,
    POINTS,
    SCHEMA,
    SCHEMA_VERSION,
    Header,
    Metrics,
    read_header,
    read_metrics,
    require_replaceable,
)
from sarsplat.runs.state import TrainingState, state_of
from sarsplat.settings.config import DEFAULT_METHOD, OWN_LOOP, SCATTERERS

if TYPE_CHECKING:
    import trimesh

_NORMAL = ("nx", "ny", "nz")
"""The columns of `points.ply` that hold normals."""


@dataclass
class InMemory:
    """What a run without a folder holds itself."""

    snapshot: Snapshot
    history: tuple[LogLine, ...]
    metrics: Metrics | None = None
    """The scores of the last evaluation."""


@dataclass(frozen=True)
class Run:
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
    """

    method: str
    config: Any
    fingerprint: str
    path: Path | None = None
    dataset_path: Path | None = None
    memory: InMemory | None = None
    device: str = "cpu"
    images: Dataset | None = field(default=None, compare=False, repr=False)

    # ---- what was learned -------------------------------------------------------------------------------------------
    @cached_property
    def snapshot(self) -> Snapshot:
        """The newest state of its training."""
        if self.memory is not None:
            return self.memory.snapshot
        if self.checkpoint_path is None:
            raise SarsplatError(f"{self.path} holds no checkpoint; reconstruct it again with overwrite=True")
        return Snapshot.load(self.checkpoint_path)

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """What its method has learned."""
        snapshot = self.snapshot
        try:
            return METHODS[self.method].open(snapshot, self.config, self.device, self.path)
        except (KeyError, ValueError, TypeError, IndexError, RuntimeError, SarsplatError) as error:
            raise SarsplatError(
                f"{self.checkpoint_path} does not hold a whole model ({shown(str(error))}); "
                "reconstruct it again with overwrite=True"
            ) from error

    @property
    def gaussians(self) -> Gaussians | None:
        """The target's Gaussians; None of methods that learn none."""
        return self.reconstruction.gaussians

    @property
    def model(self) -> SceneModel | None:
        """The learned scene of Gaussians; None of methods that learn something else."""
        return self.reconstruction.model

    @checks_arguments
    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        """Images as seen from any views.

        Parameters
        ----------
        views : sequence of View
            V views.
        grid : ImageGrid, optional
            Pixels and resolution; its own if omitted, and for other methods than `sar-gs` only that.

        Returns
        -------
        numpy.ndarray, float32 [V, rows, columns]
            β⁰, linear power.

        Raises
        ------
        SarsplatError
            If the method cannot render on that grid.

        Warns
        -----
        SarsplatWarning
            If the grid is finer than the training images.
        """
        return self.reconstruction.render(views, grid)

    @checks_arguments
    def render_covariances(
        self, views: Sequence[View], stack: Stack | Sequence[Stack], grid: ImageGrid | None = None
    ) -> Complex64[np.ndarray, "v p p rows columns"]:
        """Expected covariances E[y_i y_j*] between the passes of stacks around any views.

        Parameters
        ----------
        views : sequence of View
            V views, at least one.
        stack : Stack or sequence of Stack
            P passes, around every view or around each its own; not only those it was learned from.
        grid : ImageGrid, optional
            Pixels and resolution; its own if omitted.

        Returns
        -------
        numpy.ndarray, complex64 [V, P, P, rows, columns]
            Hermitian; phases are not deramped (`Stack.plane_phases`). On the diagonal is β⁰ with noise, the mean of all
            passes that it was learned from; other than those of `sarsplat.render_covariances`, which have none.

        Raises
        ------
        SarsplatError
            If it was not learned from interferometric stacks, there are no views, there are more or fewer stacks than
            views, of different numbers of passes, or of polarisations that it has not learned.

        Warns
        -----
        SarsplatWarning
            As `render`.
        """
        return self.reconstruction.covariances(views, stack, grid)

    @checks_arguments
    def covariance_within(self, box: Box) -> Complex128[np.ndarray, "p p"]:
        """How what lies in a box returns several polarisations together, on average over the training views.

        Single Gaussians share pixels with others, and only their sum is determined: ask about parts that are larger
        than a resolution cell.

        Parameters
        ----------
        box : pair of (x, y, z)
            Lower and upper corner, m.

        Returns
        -------
        numpy.ndarray, complex128 [P, P]
            E[y_i y_j*], m²: radar cross-sections on the diagonal, in order of its scattering's `polarisations`.

        Raises
        ------
        SarsplatError
            If it was not learned from stacks of several polarisations, or no Gaussian lies in the box.
        """
        return self.reconstruction.covariance_within(box)

    @checks_arguments
    def sample(
        self,
        view: View,
        seed: int = 0,
        *,
        ground: str | Float32[np.ndarray, "r c"] = "learned",
        speckle: Speckle = "response",
        scatterers: float = SCATTERERS,
    ) -> Complex64[np.ndarray, "rows columns"]:
        """One image as the radar would deliver it from a view, on the run's own grid; `sarsplat.chips` draws many.

        Where `render` gives the expected power, this draws what belongs to a single image: gain and displacement,
        normally distributed as those of the training images were, and speckle with receiver noise.

        Parameters
        ----------
        view : View
            From where.
        seed : int
            Of all that is drawn, at least 0: the same view and seed give the same image.
        ground : str or numpy.ndarray, float32 [R, C]
            "learned": as the training images show it, with all that is peculiar to their site; "uniform": of its mean
            brightness everywhere; or linear power of other ground without speckle, relative to that brightness, at
            least as large as the images, with pixels of the same size and near range at the top, of which parts are
            drawn (`sarsplat.samples.backdrop_of` reads it from a picture).
        speckle : {"response", "white", "none"}
            Complex noise through the radar's response, so that neighbouring pixels are alike; without that
            correlation; or none, for the power expected with this gain and displacement.
        scatterers : float
            How many scatterers of the target a pixel sees through the response at a time, on average: the fewer, the
            more its power is in single points (a K-distribution of this shape; math.inf: the exponential one of
            speckle, which that of the ground has in any case). The number is for vehicles at 0.3 m and 10 GHz.

        Returns
        -------
        numpy.ndarray, complex64 [rows, columns]
            √β⁰·e^jψ, row 0 near range; |·|² is β⁰, linear power, up to the drawn gain. Phases mean nothing where
            there is no speckle.

        Raises
        ------
        SarsplatError
            If the run has not learned how single images differ (`measured` and `speckled` do), or a choice is unknown
            or does not suit it, or there are no scatterers.
        """
        if seed < 0:
            raise SarsplatError(f"seed {seed} must be at least 0")
        return self.reconstruction.sampler(ground, speckle, scatterers)(view, seed)

    @checks_arguments
    def masks(self, views: Sequence[View]) -> UInt8[np.ndarray, "v rows columns"]:
        """What the pixels of any views show: 0 clutter, 1 target, 2 shadow; on its grid, uint8."""
        return self.reconstruction.masks(views, self.points)

    def mesh(self) -> trimesh.Trimesh:
        """Its surface as triangles, world frame, m; perhaps without faces. Made once: copy it before changing it.

        Raises
        ------
        SarsplatError
            If a package is missing, or the surface would take too many triangles.
        """
        return self._mesh

    @cached_property
    def _mesh(self) -> trimesh.Trimesh:
        """Scores, report and exports share it: in a large scene it takes minutes."""
        return self.reconstruction.mesh(self.points, self.normals)

    @cached_property
    def points(self) -> Float32[np.ndarray, "p 3"]:
        """The reconstructed surface, world frame, m.

        From `points.ply`; extracted anew if there is none, as after a training that was killed.
        """
        return self.reconstruction.points() if self._stored is None else self._stored[0]

    @cached_property
    def normals(self) -> Float32[np.ndarray, "p 3"]:
        """Unit normals of the points, on the side that the radar saw; from `points.ply` as well, if it has them."""
        columns = {} if self._stored is None else self._stored[1]
        if not columns.keys() >= set(_NORMAL):
            return self.reconstruction.normals_at(self.points)
        return np.stack([columns[name] for name in _NORMAL], axis=1)

    @cached_property
    def _stored(self) -> tuple[Float32[np.ndarray, "p 3"], dict[str, Real[np.ndarray, " p"]]] | None:
        """The content of `points.ply`, if there is one: positions, and other columns."""
        path = None if self.path is None else self.path / POINTS
        return read_points_ply(path) if path is not None and path.is_file() else None

    @cached_property
    def points_gamma0(self) -> Float32[np.ndarray, " p"] | None:
        """γ⁰ of the points, linear, as the training views saw it; None if the method does not know it."""
        return self.reconstruction.gamma0_at(self.points)

    @property
    def grid(self) -> ImageGrid:
        """Pixels of its images."""
        return self.snapshot.grid

    @property
    def brightest(self) -> float:
        """Largest β⁰ of the training images, linear power: what pictures show as white."""
        return self.snapshot.brightest

    @property
    def azimuth_offset_deg(self) -> Float64[np.ndarray, " k"]:
        """By how much the azimuths of the training views were corrected, degrees, float64 [K].

        Raises
        ------
        SarsplatError
            If the checkpoint holds something else.
        """
        offsets = self.reconstruction.azimuth_offset_deg
        count = len(self.snapshot.views)
        if offsets is None:
            return np.zeros(count)
        if offsets.shape != (count,) or not np.isfinite(offsets).all():
            raise SarsplatError(
                f"{self.checkpoint_path} does not hold one azimuth offset for each training view; "
                "reconstruct it again with overwrite=True"
            )
        return offsets

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.snapshot.iteration

    @property
    def time_s(self) -> float:
        """Training time so far, s of wall clock."""
        return self.snapshot.seconds

    @property
    def seed(self) -> int:
        """Seed of everything random."""
        seed: int = self.config.seed
        return seed

    @property
    def learned(self) -> str:
        """What was learned, in words: `4,123 Gaussians`."""
        return self.reconstruction.learned

    @property
    def facts(self) -> dict[str, str]:
        """How it was made, for readers: names and values."""
        if getattr(self.config, "preset", None) == OWN_LOOP:
            return self.reconstruction.facts
        steps, each = self.config.iterations, counted(self.config.views_per_step, "view")
        return {**self.reconstruction.facts, "iterations": f"{self.iteration:,} of {steps:,}, {each} each"}

    @property
    def about(self) -> dict[str, str]:
        """What it has learned and how it was made, for readers: names and values."""
        rows = {"learned": self.learned, **self.facts, "seed": str(self.seed), "time": f"{self.time_s:.1f} s"}
        if (offset_deg := self.azimuth_offset_deg).any():
            rms, largest = (offset_deg**2).mean() ** 0.5, abs(offset_deg).max()
            rows["azimuth corrections"] = f"rms {rms:.2f}°, largest {largest:.2f}°"
        return rows

    @property
    def loss_title(self) -> tuple[str, str]:
        """What its training minimised, and the unit of that."""
        return METHODS[self.method].loss_title(self.config)

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
                f"say where it is with `sarsplat reconstruct DATASET --out {self.path} --resume`"
            )
        dataset = read_dataset(self.dataset_path)
        if dataset.fingerprint() != self.fingerprint:
            raise SarsplatError(
                f"the dataset {self.dataset_path} is not what {self.path} was made from: it has changed since; "
                "reconstruct again"
            )
        return dataset

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
        config = method_named(header.method).settings.from_dict(header.config, str(path / HEADER))
        if dataset is not None and header.dataset_fingerprint not in ("", dataset.fingerprint()):
            raise SarsplatError(f"{path} was made from another dataset than {dataset}; give the one it was made from")
        where = None if header.dataset is None else Path(header.dataset)
        on = device_named(device).type
        return cls(header.method, config, header.dataset_fingerprint, path, where, device=on, images=dataset)

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
        return cls(DEFAULT_METHOD, config, fingerprint, None, where, held, on, dataset)

    @checks_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> Run:
        """Write the run to a folder, from where every command takes it; with the scores, if it was evaluated.

        Parameters
        ----------
        path : str or Path
            The folder; it appears when it is whole.
        overwrite : bool
            Replace an existing run.

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
            copy = replace(self, path=folder, memory=None)
            (folder / "checkpoints").mkdir()
            write_header(copy)
            self.snapshot.save(folder / "checkpoints" / f"{self.iteration:08d}.safetensors")
            write_bytes(copy.log_path, log_text(self.history))
            copy.write_results()
            if self.metrics is not None:
                write_json(folder / "metrics.json", self.metrics)
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
    def checkpoint_path(self) -> Path | None:
        """The newest checkpoint, if there is one."""
        files = [] if self.path is None else sorted((self.path / "checkpoints").glob("*.safetensors"))
        return files[-1] if files else None

    @property
    def state(self) -> TrainingState | None:
        """How far its training is, by its folder; None in memory, where only finished ones are."""
        return None if self.path is None else state_of(self.path, read_header(self.path))

    @property
    def log_path(self) -> Path:
        """Its `metrics.jsonl`."""
        return self.folder / "metrics.jsonl"

    @property
    def history(self) -> list[LogLine]:
        """The lines of `metrics.jsonl` (`read_log`)."""
        if self.memory is not None:
            return list(self.memory.history)
        return read_log(self.log_path)

    @property
    def metrics(self) -> Metrics | None:
        """The scores of the last evaluation; None before."""
        if self.memory is not None:
            return self.memory.metrics
        return None if self.path is None else read_metrics(self.path)

    def write_results(self) -> None:
        """Write what other programs read: `points.ply`, `about.json`, and what else its method has."""
        learned = self.reconstruction
        learned.write(self.folder)
        write_json(self.folder / ABOUT, self.about)
        points = learned.points()
        write_points_ply(self.folder / POINTS, points, normals=learned.normals_at(points))


def write_header(run: Run) -> None:
    """Write the `config.json` of a run with a folder."""
    where = None if run.dataset_path is None else str(run.dataset_path)
    header = Header(SCHEMA, SCHEMA_VERSION, where, run.fingerprint, run.config.as_dict(), run.method, run.target)
    write_json(run.folder / HEADER, header)
