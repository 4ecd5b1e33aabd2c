"""Base of the baseline methods: training by `BaselineTrainer`, and points where rays meet the learned surface."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from scipy.spatial import cKDTree

from sarsplat.baselines.baseline import Baseline, BaselineConfig, Scene
from sarsplat.baselines.trainer import BaselineTrainer, saved_scene, scene_of
from sarsplat.data import Dataset, read_masks, write_mesh
from sarsplat.errors import SarsplatError, shown
from sarsplat.extras import Trimesh
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.learning.method import Inputs, Method, Reconstruction
from sarsplat.learning.snapshot import Snapshot
from sarsplat.runs.run_folder import MESH
from sarsplat.scenes import load_mesh
from sarsplat.scenes._rays import Facets, first_hits

Points = Float32[np.ndarray, "p 3"]

_RAYS_PER_CELL = 4.0  # rays along the side of a resolution cell


@dataclass(frozen=True)
class BaselineMethod(Method):
    """A method whose model is a `Baseline`."""

    name: str
    """Name on the command line and in files."""
    title: str
    learns: str
    loss: str
    """Texts for readers: name, learned model (`a closed mesh`) and loss."""
    defaults: BaselineConfig
    """Default settings, whose type all settings have."""
    model: Callable[[Scene, Any], Baseline]
    """Function that makes the model of a scene, from its settings."""
    takes: frozenset[str] = frozenset()
    """`{"masks"}` if the method learns from masks of the training images."""

    @property
    def settings(self) -> type[BaselineConfig]:  # type: ignore[override]
        return type(self.defaults)

    def preset(self, name: str, dataset: Dataset) -> BaselineConfig:
        """Default settings; the only name is "auto"."""
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
        check_unstretched(dataset.views, "choose the method sar-gs")
        if begun is None:
            masks = None if inputs.masks is None else read_masks(inputs.masks, dataset, ("train",))
            scene = scene_of(dataset, None if masks is None else np.stack([*masks.values()]))
        elif inputs.masks is None:
            opened: Any = begun()  # its errors name the checkpoint
            scene = opened.baseline.scene
        else:
            raise SarsplatError(f"the run keeps the masks it was started with; omit the masks {inputs.masks}")
        return BaselineTrainer(dataset, config, self.model(scene, config), device)

    def open(
        self, snapshot: Snapshot, config: BaselineConfig, device: str, folder: Path | None
    ) -> "BaselineReconstruction":
        return BaselineReconstruction(self, snapshot, config, device, folder)

    def loss_title(self, config: BaselineConfig) -> tuple[str, str]:
        return self.loss, "loss"


class BaselineReconstruction(Reconstruction):
    """Learned baseline; its points are the first hits of the training views' rays on its surface."""

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
                f"{self.method.title} renders only the grid that it was trained with; omit size, spacing and resolution"
            )
        return self.baseline.images(views)

    def masks(self, views: Sequence[View], points: Float32[np.ndarray, "p 3"]) -> UInt8[np.ndarray, "v rows columns"]:
        """Masks of the surface on flat ground, by ray casting, which needs embreex."""
        from sarsplat.scenes.raycast import raycast_mask

        images = np.zeros((len(views), self.grid.rows, self.grid.columns), np.uint8)
        if len(self.surface.faces):
            for image, view in zip(images, views, strict=True):
                image[:] = raycast_mask(self.surface, view, self.grid)
        return images

    @cached_property
    def surface(self) -> Trimesh:
        """Surface of the target, m, world frame, from `mesh.ply` or computed; it may have no faces."""
        import trimesh

        if self.folder is not None and (self.folder / MESH).is_file():
            return load_mesh(self.folder / MESH)
        vertices, faces = self.baseline.surface()
        return trimesh.Trimesh(vertices, faces, process=False)

    def mesh(self, points: Points, normals: Points) -> Trimesh:
        """Surface including parts that no view saw."""
        return self.surface

    @cached_property
    def _hits(self) -> tuple[Points, Points]:
        return _first_hits(self.surface, self.snapshot.views, self.grid.cell_m / _RAYS_PER_CELL)

    def points(self) -> Points:
        return self._hits[0]

    def normals_at(self, points: Points) -> Points:
        """Normals of the nearest first hits."""
        hits, normals = self._hits
        return normals[cKDTree(hits).query(points)[1]] if len(points) and len(hits) else np.zeros_like(points)

    def write(self, folder: Path) -> None:
        if len(self.surface.faces):
            write_mesh(folder / MESH, self.surface)

    @property
    def learned(self) -> str:
        return f"{self.method.learns} ({self.method.title})"

    @property
    def facts(self) -> dict[str, str]:
        return {"numbers learned": f"{sum(parameter.numel() for parameter in self.baseline.parameters()):,}"}


def _first_hits(mesh: Trimesh, views: Sequence[View], spacing_m: float) -> tuple[Points, Points]:
    """First hits of parallel rays on a mesh, m, thinned to one per cube of the spacing, and their unit normals."""
    points, normals = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
    for view in views if len(mesh.faces) else ():
        frame, facets = view.look.frame, Facets.of(mesh, view)
        for position, face in first_hits(facets, (-np.inf, np.inf), spacing_m, (0.5, 0.5)):
            hit = np.column_stack([position, facets.depth(face, position)]) @ frame
            normal = mesh.face_normals[face]
            normal = normal * np.sign(normal @ view.look.facing)[:, None]
            points = np.concatenate([points, hit.astype(np.float32)])
            normals = np.concatenate([normals, normal.astype(np.float32)])
        first = np.unique(np.floor(points / spacing_m).astype(np.int64), axis=0, return_index=True)[1]
        first.sort()
        points, normals = points[first], normals[first]
    return points, normals
