"""Base of the baseline methods: training by `BaselineTrainer`, and points where rays meet the learned surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from scipy.spatial import cKDTree

from sarsplat.baselines.baseline import Baseline, BaselineConfig, Scene
from sarsplat.baselines.trainer import BaselineTrainer, saved_scene, scene_of
from sarsplat.data import Dataset, read_masks, write_mesh
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.learning.method import Inputs, Method, Reconstruction
from sarsplat.learning.snapshot import Snapshot
from sarsplat.runs.run_folder import MESH
from sarsplat.scenes import load_mesh
from sarsplat.scenes._rays import Facets, first_hits

if TYPE_CHECKING:
    import trimesh

Points = Float32[np.ndarray, "p 3"]

_RAYS_PER_CELL = 4.0
"""Along a side."""


@dataclass(frozen=True)
class BaselineMethod(Method):
    """A method whose model is a `Baseline`."""

    name: str
    """On the command line and in files."""
    title: str
    learns: str
    loss: str
    """For readers: its name, what it learns (`a closed mesh`) and what its training minimises."""
    defaults: BaselineConfig
    """Default settings; all its settings are of their type."""
    model: Callable[[Scene, Any], Baseline]
    """Makes the model of a scene before the first step."""
    takes: frozenset[str] = frozenset()
    """`{"masks"}` if it learns from masks of the training images."""

    @property
    def settings(self) -> type[BaselineConfig]:  # type: ignore[override]
        return type(self.defaults)

    def preset(self, name: str, dataset: Dataset) -> BaselineConfig:
        """Its default settings; there is only "auto"."""
        if name != "auto":
            raise SarsplatError(f"{self.name} has no presets, so {shown(name)} is unknown; omit it, or give settings")
        return self.defaults

    def trainer(
        self,
        dataset: Dataset,
        config: BaselineConfig,
        inputs: Inputs,
        device: torch.device,
        begun: Callable[[], Reconstruction] | None,
    ) -> BaselineTrainer:
        """A training at its beginning; a resumed one keeps its masks."""
        check_unstretched(dataset.views)
        if begun is None:
            masks = None if inputs.masks is None else read_masks(inputs.masks, dataset, ("train",))
            scene = scene_of(dataset, None if masks is None else np.stack([*masks.values()]))
        elif inputs.masks is None:
            opened: Any = begun()  # by `open`, with errors that name the checkpoint
            scene = opened.baseline.scene
        else:
            raise SarsplatError(f"the run keeps the masks it was started with; omit the masks {inputs.masks}")
        return BaselineTrainer(dataset, config, self.model(scene, config), device)

    def open(
        self, snapshot: Snapshot, config: BaselineConfig, device: str, folder: Path | None
    ) -> BaselineReconstruction:
        return BaselineReconstruction(self, snapshot, config, device, folder)

    def loss_title(self, config: BaselineConfig) -> tuple[str, str]:
        return self.loss, "loss"


class BaselineReconstruction(Reconstruction):
    """What a baseline has learned; its points are where rays of the training views meet its surface."""

    def __init__(
        self, method: BaselineMethod, snapshot: Snapshot, config: BaselineConfig, device: str, folder: Path | None
    ) -> None:
        self.method, self.snapshot, self.folder = method, snapshot, folder
        self.grid = snapshot.grid
        self.baseline = method.model(saved_scene(snapshot), config)
        self.baseline.load_state_dict(snapshot.like("model", self.baseline.state_dict()))
        self.baseline.to(device)

    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        if grid not in (None, self.grid):
            raise SarsplatError(
                f"{self.method.title} renders the pixels that it was trained with, and no others; "
                "omit the size, spacing and resolution"
            )
        return self.baseline.images(views)

    def masks(self, views: Sequence[View], points: Float32[np.ndarray, "p 3"]) -> UInt8[np.ndarray, "v rows columns"]:
        """Masks of its surface on flat ground, by ray casting, which needs embreex."""
        from sarsplat.scenes.raycast import raycast_mask

        images = np.zeros((len(views), self.grid.rows, self.grid.columns), np.uint8)
        if len(self.surface.faces):
            for image, view in zip(images, views, strict=True):
                image[:] = raycast_mask(self.surface, view, self.grid)
        return images

    @cached_property
    def surface(self) -> trimesh.Trimesh:
        """The target's surface, m, world frame, perhaps without faces: from `mesh.ply`, or computed if that is lost."""
        import trimesh

        if self.folder is not None and (self.folder / MESH).is_file():
            return load_mesh(self.folder / MESH)
        vertices, faces = self.baseline.surface()
        return trimesh.Trimesh(vertices, faces, process=False)

    def mesh(self, points: Points, normals: Points) -> trimesh.Trimesh:
        """The whole surface, including parts that no view saw."""
        return self.surface

    @cached_property
    def _seen(self) -> tuple[Points, Points]:
        return _seen_points(self.surface, self.snapshot.views, self.grid.cell_m / _RAYS_PER_CELL)

    def points(self) -> Points:
        return self._seen[0]

    def normals_at(self, points: Points) -> Points:
        """Normals of the nearest points that rays meet."""
        seen, normals = self._seen
        return normals[cKDTree(seen).query(points)[1]] if len(points) and len(seen) else np.zeros_like(points)

    def write(self, folder: Path) -> None:
        if len(self.surface.faces):
            write_mesh(folder / MESH, self.surface)

    @property
    def learned(self) -> str:
        return f"{self.method.learns} ({self.method.title})"

    @property
    def facts(self) -> dict[str, str]:
        return {"numbers learned": f"{sum(parameter.numel() for parameter in self.baseline.parameters()):,}"}


def _seen_points(mesh: trimesh.Trimesh, views: Sequence[View], spacing_m: float) -> tuple[Points, Points]:
    """Points where parallel rays first meet a mesh, m, one in each cube of the spacing, and unit normals there."""
    points, normals = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
    for view in views if len(mesh.faces) else ():
        frame, facets = view.look.frame, Facets.of(mesh, view)
        for position, face in first_hits(facets, (-np.inf, np.inf), spacing_m, (0.5, 0.5)):
            hit = np.column_stack([position, facets.depth(face, position)]) @ frame
            normal = mesh.face_normals[face]
            normal = normal * np.sign(normal @ view.look.facing)[:, None]
            points = np.concatenate([points, hit.astype(np.float32)])
            normals = np.concatenate([normals, normal.astype(np.float32)])
        kept = np.unique(np.floor(points / spacing_m).astype(np.int64), axis=0, return_index=True)[1]
        kept.sort()
        points, normals = points[kept], normals[kept]
    return points, normals
