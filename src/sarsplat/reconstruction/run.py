"""A reconstruction of Gaussians: what was learned, and what is made of it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from sarsplat.data import write_gaussians_ply
from sarsplat.errors import SarsplatError, SarsplatWarning, counted, shown
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.reconstruction.any_run import AnyRun, Header
from sarsplat.reconstruction.config import OURS, Config
from sarsplat.reconstruction.losses import LOSSES
from sarsplat.reconstruction.masks import scene_masks, without_imitated_ground
from sarsplat.reconstruction.mesh import surface_mesh
from sarsplat.reconstruction.model import SceneModel
from sarsplat.reconstruction.normals import surface_normals
from sarsplat.reconstruction.points import extract_points
from sarsplat.reconstruction.saved_model import AZIMUTH_OFFSETS, saved_model
from sarsplat.reconstruction.seen import Seen
from sarsplat.renderer import channel_of

if TYPE_CHECKING:
    import trimesh

_NORMAL_RADIUS = 1.0  # of the neighbours that tell the normal of a point, resolution cells
_EVALUATION_RAYS_PER_PIXEL = 4.0
_VIEWS_AT_A_TIME = 8


@dataclass(frozen=True)
class Run(AnyRun[Config]):
    """A reconstruction of Gaussians; its folder also holds `gaussians.ply`."""

    @property
    def method(self) -> str:
        """See `AnyRun`."""
        return OURS

    @classmethod
    def _of_header(cls, header: Header, source: str) -> dict[str, Any]:
        if header.method != OURS:
            raise SarsplatError(
                f"{source} is of a run by the method {shown(header.method)}, which learned no Gaussians; give a run by "
                f"{OURS}, or open it with sarsplat.baselines.open_run"
            )
        return {"config": Config.from_dict(header.config, source)}

    @cached_property
    def model(self) -> SceneModel:
        """The learned scene."""
        snapshot = self.snapshot
        try:
            return saved_model(snapshot, self.config, self.device)
        except (KeyError, ValueError, TypeError, IndexError, RuntimeError, SarsplatError) as error:
            raise SarsplatError(
                f"{self.checkpoint_path} does not hold a whole model ({shown(str(error))}); "
                "reconstruct it again with --overwrite"
            ) from error

    @property
    def gaussians(self) -> Gaussians:
        """The target's Gaussians."""
        return self.model.target(self.model.degree(self.iteration)).detach()

    def mesh(self) -> trimesh.Trimesh:
        """The surface through the points as triangles, world frame, m.

        Its vertices have the attribute `gamma0`, γ⁰ (linear), and colours that show it in decibels. It is open where no
        view looked, and has no faces if there are no points.

        Raises
        ------
        SarsplatError
            If scikit-image or trimesh is missing, or the points span too many voxels.
        """
        return surface_mesh(self.points, self.normals, self._seen, self.grid.cell_m)

    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        """See `AnyRun`.

        Rays are at a quarter of its own pixel spacing on every grid: they measure how much each Gaussian is lit, which
        has nothing to do with the pixels.
        """
        grid = grid or self.grid
        if any(asked < 0.999 * own for asked, own in zip(grid.resolution_m, self.grid.resolution_m, strict=True)):
            warnings.warn(_finer(grid, self.grid), SarsplatWarning, stacklevel=2)
        rays, degree = RayGrid.for_image(self.grid, _EVALUATION_RAYS_PER_PIXEL), self.model.degree(self.iteration)
        images = [np.empty((0, grid.rows, grid.columns), np.float32)]
        with torch.no_grad():
            for first in range(0, len(views), _VIEWS_AT_A_TIME):  # memory stays small
                some = views[first : first + _VIEWS_AT_A_TIME]
                rendered = self.model.render(some, grid, degree, rays=rays)[0]
                images.append(channel_of(rendered, self.model.power_channel).cpu().numpy())
        return np.concatenate(images)

    def masks(self, views: Sequence[View]) -> UInt8[np.ndarray, "v rows columns"]:
        """What the pixels of any views show: 0 clutter, 1 target, 2 shadow; on its grid, uint8.

        By what target and ground would return, each alone, at the sharpness of the pixels
        (`sarsplat.reconstruction.masks.scene_masks`), where `render` shows them. The target are the Gaussians near the
        points and, if ground was learned, at least one resolution cell above it: others may stand for clutter as well
        as the ground does. Without learned ground there is no shadow.
        """
        scene = self.model.scene(self.model.degree(self.iteration)).detach()
        scene, count = without_imitated_ground(scene, len(self.model), self.points, self.grid.cell_m)
        rays = RayGrid.for_image(self.grid, _EVALUATION_RAYS_PER_PIXEL)
        return scene_masks(scene, count, views, self.model.as_displaced(self.grid), rays)

    @cached_property
    def azimuth_offset_deg(self) -> Float64[np.ndarray, " k"]:
        """By how much the azimuths of the training views were corrected, degrees, float64 [K]; 0 where not uncertain.

        Raises
        ------
        SarsplatError
            If the checkpoint holds something else.
        """
        offsets = self.snapshot.tensors.get(AZIMUTH_OFFSETS, torch.zeros(len(self.snapshot.views)).double())
        if offsets.shape != (len(self.snapshot.views),) or not offsets.isfinite().all():
            raise SarsplatError(
                f"{self.checkpoint_path} does not hold one azimuth offset for each training view; "
                "reconstruct it again with --overwrite"
            )
        return offsets.double().numpy()

    def _extracted_points(self) -> Float32[np.ndarray, "p 3"]:
        points = extract_points(self.gaussians, self.snapshot.views, self.grid, self.config.points)
        return points.astype(np.float32)  # as the file has them

    def _normals_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, "p 3"]:
        """Of the planes through their neighbours."""
        towards = self._seen.around(points)[1]
        return surface_normals(points, towards, _NORMAL_RADIUS * self.grid.cell_m).astype(np.float32)

    @cached_property
    def points_gamma0(self) -> Float32[np.ndarray, " p"]:
        """See `AnyRun`: the mean over the views that see the Gaussians there, weighted by how much they see."""
        return self._seen.around(self.points)[0].astype(np.float32)

    @cached_property
    def _seen(self) -> Seen:
        return Seen.of(self.gaussians, self.snapshot.views, self.grid)

    def write_results(self) -> None:
        """Write `gaussians.ply` and `points.ply`."""
        write_gaussians_ply(self.folder / "gaussians.ply", self.gaussians)
        super().write_results()

    # ---- for readers ------------------------------------------------------------------------------------------------
    @property
    def learned(self) -> str:
        """See `AnyRun`."""
        return counted(len(self.gaussians), "Gaussian")

    @property
    def facts(self) -> dict[str, str]:
        """See `AnyRun`."""
        config = self.config
        return {
            "preset": config.preset,
            "start": config.initialisation,
            "iterations": f"{self.iteration:,} of {config.iterations:,}, {counted(config.views_per_step, 'view')} each",
        }

    @property
    def loss_title(self) -> tuple[str, str]:
        """See `AnyRun`."""
        known = LOSSES.get(self.config.loss)
        return (known.title, known.unit) if known else (f"function {self.config.loss}", "loss")


def _finer(asked: ImageGrid, own: ImageGrid) -> str:
    def metres(pair: tuple[float, float]) -> str:
        return " × ".join(f"{width:.3g}" for width in dict.fromkeys(pair)) + " m"

    return (
        f"a resolution of {metres(asked.resolution_m)} is finer than the {metres(own.resolution_m)} of the training "
        "images, so the images show single Gaussians rather than the target; ask for no finer one"
    )
