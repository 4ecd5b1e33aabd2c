"""What a training has learned: it renders, and has points, normals and a mesh, without its dataset."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex64, Complex128, Float32, Float64, Real, UInt8

from sarsplat.arguments import checks_arguments
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.learning.method import Reconstruction
from sarsplat.learning.model import SceneModel
from sarsplat.learning.snapshot import Snapshot
from sarsplat.names import Speckle
from sarsplat.runs.methods import METHODS
from sarsplat.runs.run_folder import RunFolder
from sarsplat.settings.config import OWN_LOOP, SCATTERERS

if TYPE_CHECKING:
    import trimesh

_NORMAL = ("nx", "ny", "nz")
"""The columns of `points.ply` that hold normals."""


class Result(ABC):
    """What was learned by a method, with its settings, on a device; from a checkpoint in memory or in a folder."""

    method: str
    config: Any
    device: str

    @property
    @abstractmethod
    def snapshot(self) -> Snapshot:
        """The newest state of its training."""

    @property
    @abstractmethod
    def files(self) -> RunFolder | None:
        """Its folder; None if it is in memory only."""

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """What its method has learned."""
        snapshot, folder = self.snapshot, None if self.files is None else self.files.path
        try:
            return METHODS[self.method].open(snapshot, self.config, self.device, folder)
        except (KeyError, ValueError, TypeError, IndexError, RuntimeError, SarsplatError) as error:
            raise SarsplatError(
                f"{self._checkpoint} does not hold a whole model ({shown(str(error))}); "
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
        return None if self.files is None else self.files.points

    @cached_property
    def points_gamma0(self) -> Float32[np.ndarray, " p"] | None:
        """γ⁰ of the points, linear, as the training views saw it; None if the method does not know it."""
        return self.reconstruction.gamma0_at(self.points)

    @property
    def _checkpoint(self) -> str:
        """Where its state is, for errors."""
        return "the run in memory" if self.files is None else str(self.files.checkpoint_path)

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
