"""A reconstruction by a method that is not ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from scipy.spatial import cKDTree

from sarsplat.baselines.baseline import Baseline
from sarsplat.baselines.config import BaselineConfig
from sarsplat.baselines.methods import METHODS, Method
from sarsplat.baselines.seen_points import Points, seen_points
from sarsplat.baselines.trainer import rebuilt
from sarsplat.data import write_mesh
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.geometry import ImageGrid, View
from sarsplat.reconstruction import AnyRun, Run
from sarsplat.reconstruction.any_run import MESH, Header, read_header
from sarsplat.reconstruction.config import OURS
from sarsplat.scenes import load_mesh

if TYPE_CHECKING:
    import trimesh

_RAYS_PER_CELL = 4.0
"""Along a side."""


@dataclass(frozen=True)
class BaselineRun(AnyRun[BaselineConfig]):
    """A reconstruction by one of `METHODS`; its points are where rays of the training views meet its surface."""

    name: str = ""

    @property
    def method(self) -> str:
        """See `AnyRun`."""
        return self.name

    @classmethod
    def _of_header(cls, header: Header, source: str) -> dict[str, Any]:
        method = METHODS.get(header.method)
        if method is None:
            raise SarsplatError(
                f"{source} is of a run by the method {shown(header.method)}; give one by {', '.join(METHODS)}"
            )
        return {"config": method.read_settings(header.config, source), "name": method.name}

    @property
    def _method(self) -> Method:
        return METHODS[self.name]

    # ---- what was learned -------------------------------------------------------------------------------------------
    @cached_property
    def model(self) -> Baseline:
        """The learned scene."""
        snapshot = self.snapshot
        try:
            return rebuilt(snapshot, self._method, self.config, self.device)
        except (KeyError, ValueError, TypeError, RuntimeError, SarsplatError) as error:
            raise SarsplatError(
                f"{self.checkpoint_path} does not hold a whole model ({shown(str(error))}); "
                "reconstruct it again with --overwrite"
            ) from error

    @torch.no_grad()
    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        """See `AnyRun`; on its own grid only.

        Raises
        ------
        SarsplatError
            If another grid is asked for.
        """
        if grid not in (None, self.grid):
            raise SarsplatError(
                f"{self._method.title} renders the pixels that it was trained with, and no others; "
                "leave out the size, spacing and resolution"
            )
        images = np.empty((len(views), self.grid.rows, self.grid.columns), np.float32)
        for image, view in zip(images, views, strict=True):
            image[:] = (self.model.image(view) * self.snapshot.unit).cpu().numpy()
        return images

    def masks(self, views: Sequence[View]) -> UInt8[np.ndarray, "v rows columns"]:
        """See `AnyRun`: of its surface on flat ground, by ray casting.

        Raises
        ------
        SarsplatError
            If embreex is missing.
        """
        from sarsplat.scenes.raycast_masks import raycast_mask

        images = np.zeros((len(views), self.grid.rows, self.grid.columns), np.uint8)
        if len(self.surface.faces):
            for image, view in zip(images, views, strict=True):
                image[:] = raycast_mask(self.surface, view, self.grid)
        return images

    @cached_property
    def surface(self) -> trimesh.Trimesh:
        """What it takes for the target's surface, m, world frame; perhaps without faces.

        From `mesh.ply`; made anew if there is none, as after a training that was killed.
        """
        import trimesh

        if self.path is not None and (self.path / MESH).is_file():
            return load_mesh(self.path / MESH)
        vertices, faces = self.model.surface()
        return trimesh.Trimesh(vertices, faces, process=False)

    def mesh(self) -> trimesh.Trimesh:
        """See `AnyRun`; closed, unlike ours, so parts of it may be what no view saw."""
        return self.surface

    @cached_property
    def _seen(self) -> tuple[Points, Points]:
        return seen_points(self.surface, self.snapshot.views, self.grid.cell_m / _RAYS_PER_CELL)

    def _extracted_points(self) -> Points:
        return self._seen[0]

    def _normals_at(self, points: Points) -> Points:
        found, normals = self._seen
        return normals[cKDTree(found).query(points)[1]] if len(points) and len(found) else np.zeros_like(points)

    def write_results(self) -> None:
        """Write `mesh.ply`, if there is a surface, and `points.ply`."""
        if len(self.surface.faces):
            write_mesh(self.folder / MESH, self.surface)
        super().write_results()

    # ---- for readers ------------------------------------------------------------------------------------------------
    @property
    def learned(self) -> str:
        """See `AnyRun`."""
        return f"{self._method.learns} ({self._method.title})"

    @property
    def facts(self) -> dict[str, str]:
        """See `AnyRun`."""
        config = self.config
        return {
            "numbers learned": f"{sum(parameter.numel() for parameter in self.model.parameters()):,}",
            "iterations": f"{self.iteration:,} of {config.iterations:,}, {counted(config.views_per_step, 'view')} each",
        }

    @property
    def loss_title(self) -> tuple[str, str]:
        """See `AnyRun`."""
        return self._method.loss, "loss"


def open_run(path: str | Path, device: str = "cpu") -> Run | BaselineRun:
    """Read the folder of a run by any method; everything else is as in `Run.load`.

    Raises
    ------
    SarsplatError
        As in `Run.load`.
    """
    path = Path(path)
    run_type = Run if read_header(path).method == OURS else BaselineRun
    return run_type.load(path, device)
