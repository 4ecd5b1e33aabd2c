"""Results of a training, computed from its checkpoint alone: images, points, normals, mesh."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex64, Complex128, Float32, Float64, Real, UInt8

from sarsplat.arguments import checks_arguments
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.extras import Trimesh
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.learning.method import Reconstruction
from sarsplat.learning.model import SceneModel
from sarsplat.learning.snapshot import Snapshot
from sarsplat.names import Speckle
from sarsplat.runs.methods import METHODS
from sarsplat.runs.run_folder import InMemory, RunFolder
from sarsplat.settings.config import OWN_LOOP, SCATTERERS

_NORMAL = ("nx", "ny", "nz")  # columns of normals in `points.ply`


class _Copied(cached_property[np.ndarray]):
    """Cached array that every access copies: changes of a copy do not reach scores, report and exports."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        array = super().__get__(instance, owner)
        return self if instance is None else array.copy()

    def __set__(self, instance: object, value: object) -> None:  # with it, every access calls `__get__`
        raise AttributeError(f"{self.attrname} cannot be set; it is made from the checkpoint")


class Result:
    """Results of a method's checkpoint, in a folder or in memory."""

    method: str
    config: Any
    path: Path | None
    memory: InMemory | None
    device: str

    @property
    def folder(self) -> Path:
        """Folder of the run; raises a SarsplatError if the run is in memory."""
        if self.path is None:
            raise SarsplatError("this run is in memory and has no folder; save it first with run.save(PATH)")
        return self.path

    @property
    def store(self) -> RunFolder | InMemory:
        """Storage of checkpoint, log and scores."""
        return self.memory or RunFolder(self.folder)

    @cached_property
    def snapshot(self) -> Snapshot:
        """Newest state of the training."""
        return self.store.snapshot

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Model that the method has learned."""
        snapshot = self.snapshot
        try:
            return METHODS[self.method].open(snapshot, self.config, self.device, self.store.path)
        except (KeyError, ValueError, TypeError, IndexError, RuntimeError, SarsplatError) as error:
            raise SarsplatError(
                f"{self._checkpoint} does not hold a whole model ({shown(str(error))}); "
                "reconstruct it again with overwrite=True"
            ) from error

    @property
    def gaussians(self) -> Gaussians | None:
        """Gaussians of the target; None for methods without.

        Normal lobes have the γ⁰ of the images; other laws have γ⁰ divided by `snapshot.unit`.
        """
        learned, unit = self.reconstruction.gaussians, self.snapshot.unit
        if learned is None or unit == 1:
            return learned
        return replace(learned, scattering=learned.scattering.times(unit))

    @property
    def model(self) -> SceneModel | None:
        """Learned scene of Gaussians; None for methods without."""
        return self.reconstruction.model

    @checks_arguments
    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        """Render images from any views.

        Parameters
        ----------
        views : sequence of View
            V views.
        grid : ImageGrid, optional
            Pixels and resolution; by default the run's, the only one of methods other than `sar-gs`.

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
        """Render expected covariances E[y_i y_j*] between the passes of stacks around any views.

        Parameters
        ----------
        views : sequence of View
            V views, at least one.
        stack : Stack or sequence of Stack
            P passes around all views, or one stack for each view; any, not only the training stacks.
        grid : ImageGrid, optional
            Pixels and resolution; by default the run's.

        Returns
        -------
        numpy.ndarray, complex64 [V, P, P, rows, columns]
            Hermitian; phases are not deramped (`Stack.plane_phases`). Unlike in `sarsplat.render_covariances`, the
            diagonal β⁰ includes noise, the mean over training passes.

        Raises
        ------
        SarsplatError
            If the run was not trained on interferometric stacks, there are no views, or stacks differ from the views
            in number, from each other in passes, or from the training in polarisations.

        Warns
        -----
        SarsplatWarning
            As `render`.
        """
        return self.reconstruction.covariances(views, stack, grid)

    @checks_arguments
    def covariance_within(self, box: Box) -> Complex128[np.ndarray, "p p"]:
        """Return the polarimetric covariance of the Gaussians in a box, averaged over the training views.

        Gaussians share pixels, so that only sums are determined: use boxes larger than a resolution cell.

        Parameters
        ----------
        box : pair of (x, y, z)
            Lower and upper corner, m.

        Returns
        -------
        numpy.ndarray, complex128 [P, P]
            E[y_i y_j*], m², in the order of the scattering's `polarisations`; the diagonal has radar cross-sections.

        Raises
        ------
        SarsplatError
            If the run was not trained on several polarisations, or no Gaussian lies in the box.
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
        """Draw one image with speckle as the radar would deliver it, on the run's grid; `sarsplat.chips` draws many.

        `render` gives the expected power; this also draws gain and displacement, normally distributed as in the
        training images, and speckle with receiver noise.

        Parameters
        ----------
        view : View
            The view.
        seed : int
            Seed of all random numbers, at least 0.
        ground : str or numpy.ndarray, float32 [R, C]
            "learned": as in the training images; "uniform": their mean brightness; or linear power of other ground
            without speckle relative to that brightness, with the same pixels and near range at the top, at least as
            large as an image; parts of it are drawn (`sarsplat.samples.backdrop_of` reads it from a picture).
        speckle : {"response", "white", "none"}
            Complex noise correlated by the radar's response, uncorrelated noise, or none, which leaves the expected
            power with this gain and displacement.
        scatterers : float
            Mean number of the target's scatterers per resolution cell, the shape of its K-distribution: the fewer, the
            more power is in single points; math.inf: exponential, as ground always is. The default is for vehicles at
            0.3 m and 10 GHz.

        Returns
        -------
        numpy.ndarray, complex64 [rows, columns]
            √β⁰·e^jψ, row 0 near range; |·|² is β⁰, linear power, up to the drawn gain. Phases are meaningless without
            speckle.

        Raises
        ------
        SarsplatError
            If the run has not learned the variation of single images (`measured` and `speckled` do), or an argument is
            invalid or does not fit the run.
        """
        if seed < 0:
            raise SarsplatError(f"seed is {seed}; give at least 0")
        return self.reconstruction.sampler(ground, speckle, scatterers)(view, seed)

    @checks_arguments
    def masks(self, views: Sequence[View]) -> UInt8[np.ndarray, "v rows columns"]:
        """Return masks of any views on the run's grid: 0 clutter, 1 target, 2 shadow."""
        return self.reconstruction.masks(views, self.points)

    def mesh(self) -> Trimesh:
        """Return the surface as triangles, world frame, m; perhaps without faces. It is cached: copy before changes.

        Raises a SarsplatError if a package is missing, or the surface would take too many triangles.
        """
        return self._mesh

    @cached_property
    def _mesh(self) -> Trimesh:
        """Mesh shared by scores, report and exports: in a large scene it takes minutes."""
        return self.reconstruction.mesh(self.points, self.normals)

    @_Copied
    def points(self) -> Float32[np.ndarray, "p 3"]:
        """Points of the surface, world frame, m, a copy; from `points.ply`, extracted if that is missing."""
        return self.reconstruction.points() if self._stored is None else self._stored[0]

    @_Copied
    def normals(self) -> Float32[np.ndarray, "p 3"]:
        """Unit normals of the points towards the radar, a copy; from `points.ply` if it has them."""
        columns = {} if self._stored is None else self._stored[1]
        if not columns.keys() >= set(_NORMAL):
            return self.reconstruction.normals_at(self.points)
        return np.stack([columns[name] for name in _NORMAL], axis=1)

    @cached_property
    def _stored(self) -> tuple[Float32[np.ndarray, "p 3"], dict[str, Real[np.ndarray, " p"]]] | None:
        return self.store.points

    @cached_property
    def points_gamma0(self) -> Float32[np.ndarray, " p"] | None:
        """γ⁰ of the points from the training views, linear; None for methods without."""
        return self.reconstruction.gamma0_at(self.points)

    @property
    def _checkpoint(self) -> str:
        """Name of the checkpoint, for errors."""
        return str(self.store.checkpoint_path or "the run in memory")

    @property
    def grid(self) -> ImageGrid:
        """Pixels of its images."""
        return self.snapshot.grid

    @property
    def brightest(self) -> float:
        """Largest β⁰ of the training images, linear power; white in pictures."""
        return self.snapshot.brightest

    @property
    def azimuth_offset_deg(self) -> Float64[np.ndarray, " k"]:
        """Corrections of the training views' azimuths, degrees, float64 [K]; raises if the checkpoint is damaged."""
        offsets = self.reconstruction.azimuth_offset_deg
        count = len(self.snapshot.views)
        if offsets is None:
            return np.zeros(count)
        if offsets.shape != (count,) or not np.isfinite(offsets).all():
            raise SarsplatError(
                f"{self._checkpoint} does not hold one azimuth offset for each training view; "
                "reconstruct it again with overwrite=True"
            )
        return offsets

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.snapshot.iteration

    @property
    def time_s(self) -> float:
        """Training time so far, wall clock, s."""
        return self.snapshot.seconds

    @property
    def seed(self) -> int:
        """Seed of everything random."""
        return int(self.config.seed)

    @property
    def learned(self) -> str:
        """Size of the learned model in words: `4,123 Gaussians`."""
        return self.reconstruction.learned

    @property
    def facts(self) -> dict[str, str]:
        """Names and values of the settings, for readers."""
        if getattr(self.config, "preset", None) == OWN_LOOP:
            return self.reconstruction.facts
        steps, each = self.config.iterations, counted(self.config.views_per_step, "view")
        return {**self.reconstruction.facts, "iterations": f"{self.iteration:,} of {steps:,}, {each} each"}

    @property
    def about(self) -> dict[str, str]:
        """Names and values of size, settings, seed, time and corrections, for readers."""
        rows = {"learned": self.learned, **self.facts, "seed": str(self.seed), "time": f"{self.time_s:.1f} s"}
        if (offset_deg := self.azimuth_offset_deg).any():
            rms, largest = (offset_deg**2).mean() ** 0.5, abs(offset_deg).max()
            rows["azimuth corrections"] = f"rms {rms:.2f}°, largest {largest:.2f}°"
        return rows

    @property
    def loss_title(self) -> tuple[str, str]:
        """Title of the loss, and its unit."""
        return METHODS[self.method].loss_title(self.config)
