"""The method `sar-gs`: a target of 3D Gaussians, its renderings, points, normals and masks."""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex64, Complex128, Float32, Float64, UInt8

from sarsplat.data import Dataset, DatasetEntry
from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError, SarsplatWarning, counted
from sarsplat.extras import Trimesh
from sarsplat.gaussians import Gaussians, Polarimetric
from sarsplat.gaussians.law_polarimetric import covariances_between
from sarsplat.geometry import ImageGrid, RayGrid, Stack, View
from sarsplat.learning.evidence import chosen
from sarsplat.learning.losses import LOSSES
from sarsplat.learning.method import Inputs, Method, Reconstruction
from sarsplat.learning.model import SceneModel
from sarsplat.learning.observations import observations_of
from sarsplat.learning.parts.target import scales_m
from sarsplat.learning.sampler import Sampler
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies.views import AZIMUTH_OFFSETS, TURN_CORRECTIONS, corrected_views, uncertain_passes
from sarsplat.learning.trainer import Trainer
from sarsplat.names import Speckle
from sarsplat.regions.target_region import spans
from sarsplat.renderer import GroundBounce, attenuate, project
from sarsplat.renderer.covariances import stacks_of
from sarsplat.settings.config import DEFAULT_METHOD, OWN_LOOP, Config
from sarsplat.settings.presets import preset
from sarsplat.settings.sections import FlatGround
from sarsplat.surface.cells import parts_of
from sarsplat.surface.masks import scene_masks, without_imitated_ground
from sarsplat.surface.mesh import surface_mesh
from sarsplat.surface.neighbours import spacing_m
from sarsplat.surface.normals import surface_normals
from sarsplat.surface.points import extract_points
from sarsplat.surface.visibility import Seen

_EVALUATION_RAYS_PER_PIXEL = 4.0
_NORMAL_REACH = 3.0  # radius of the points that determine a normal, resolution cells
_MAX_PASSES = 6  # listed in reports
_NO_GROUND = -1e6  # minimum height of points of a target aloft, resolution cells


class SarGs(Method):
    """3D Gaussians with optical depth and scattering, learned through the differentiable renderer."""

    name = DEFAULT_METHOD
    title = "sarsplat"
    settings = Config
    takes = frozenset({"loss", "strategies"})
    watchable = True

    def preset(self, name: str, dataset: Dataset) -> Config:
        """Return a preset; "auto" chooses by speckle, stacks and ground. Ground in images is always modelled."""
        if name == "auto":
            name = "default" if dataset.looks is None else "speckled"
            name = "polarimetric" if dataset.polarimetric else "stack" if dataset.interferometric else name
            if name == "speckled" and dataset.ground:
                return chosen(dataset)
        config = preset(name)
        if dataset.ground and config.passes is None and config.ground is None and name != "paper":  # has none
            return replace(config, ground=FlatGround())
        return config

    def trainer(
        self,
        dataset: Dataset,
        config: Config,
        inputs: Inputs,
        device: torch.device,
        begun: Callable[[], Reconstruction] | None,
    ) -> Trainer:
        """Return a new trainer; a custom loss gives its name to the settings."""
        if inputs.loss is not None:
            name = getattr(inputs.loss, "__name__", type(inputs.loss).__name__)
            config = replace(config, loss=f"own {name}" if name in LOSSES else name)
        if dataset.views[0].aloft and (config.ground or (config.surroundings and config.surroundings.texture_looks)):
            asked = "ground is on" if config.ground else "texture_looks, of ground, is not 0"
            raise SarsplatError(
                f"{dataset} is of a target aloft, where there is no ground, but {asked} (preset {config.preset}); "
                "leave that off, as the presets default and speckled do"
            )
        for observation in observations_of(config):
            observation.refuse(config, dataset, inputs)
        return Trainer(dataset, config, inputs.loss, device, inputs.strategies)

    def open(self, snapshot: Snapshot, config: Config, device: str, folder: Path | None) -> "GaussianReconstruction":
        return GaussianReconstruction(snapshot, config, device)

    def loss_title(self, config: Config) -> tuple[str, str]:
        loss = LOSSES.get(config.loss)
        return (loss.title, loss.unit) if loss else (f"function {config.loss}", "loss")

    def by_tiles(self, config: Config) -> bool:
        return config.tiles > 1

    def about(self, config: Config, grid: ImageGrid) -> tuple[str, str]:
        """Return the preset; the evidence for it, if any, and lengths in metres."""
        return config.preset, "\n".join(filter(None, (config.evidence, lengths(config, grid))))


METHOD = SarGs()


class GaussianReconstruction(Reconstruction):
    """A scene of Gaussians; its folder also gets `gaussians.ply`. Errors as in `Method.open`."""

    model: SceneModel

    def __init__(self, snapshot: Snapshot, config: Config, device: str) -> None:
        self.snapshot, self.config, self.grid = snapshot, config, snapshot.grid
        self.model = SceneModel.saved(snapshot, config, device)

    @property
    def gaussians(self) -> Gaussians:  # type: ignore[override]
        return self.model.target(self._degree).detach()

    @property
    def _degree(self) -> int:
        return self.model.degree(self.snapshot.iteration)

    def mesh(self, points: Float32[np.ndarray, "p 3"], normals: Float32[np.ndarray, "p 3"]) -> Trimesh:
        """The surface through the points, with γ⁰ of its vertices (`surface_mesh`); open where no view looked."""
        return surface_mesh(points, normals, self._seen, self.grid.cell_m)

    def render(self, views: Sequence[View], grid: ImageGrid | None = None) -> Float32[np.ndarray, "v rows columns"]:
        grid = grid or self.grid
        return self.model.unseen(views, grid, self._degree, self._rays(grid))

    def covariances(
        self, views: Sequence[View], stack: Stack | Sequence[Stack], grid: ImageGrid | None = None
    ) -> Complex64[np.ndarray, "v p p rows columns"]:
        """Return covariances with the learned noise; raise if the run was learned from power."""
        if self.config.passes is None and self.config.preset != OWN_LOOP:
            return super().covariances(views, stack, grid)
        grid, stacks = grid or self.grid, stacks_of(self.gaussians.scattering, views, stack)
        rays = self._rays(grid)
        with torch.no_grad():
            found = [  # one at a time: many passes take much memory
                self.model.covariances([view], [one], grid, self._degree, rays=rays)[0].whole().cpu().numpy()
                for view, one in zip(views, stacks, strict=True)
            ]
        return self.snapshot.unit * np.concatenate(found)

    def covariance_within(self, box: Box) -> Complex128[np.ndarray, "p p"]:
        """E[y yᴴ] of the Gaussians whose centres lie in the box, on average over the training views."""
        gaussians = self.gaussians
        law = gaussians.scattering
        if not isinstance(law, Polarimetric):
            return super().covariance_within(box)
        corners = [torch.tensor(corner, dtype=torch.float64).to(gaussians.means) for corner in box]
        inside = ((gaussians.means >= corners[0]) & (gaussians.means <= corners[1])).all(dim=1)
        if not bool(inside.any()):
            raise SarsplatError(
                f"no Gaussian lies in the box {box[0]} to {box[1]} m; give the lower corner (x, y, z) and the upper one"
            )
        count = len(law.polarisations)
        total, rays = np.zeros((count, count), np.complex128), self._rays(self.grid)
        with torch.no_grad():
            for view in self.snapshot.views:  # one at a time: scenes may be large
                projection = project(gaussians, [view], self.grid, rays=rays)
                lit_area = attenuate(projection, rays).lit_area[0, inside]
                lit = (projection.amplitudes[0, inside] * lit_area[:, None]).double().sum(0)
                total += covariances_between(lit, count).cpu().numpy()
        return self.snapshot.unit * (total / len(self.snapshot.views))

    def _rays(self, grid: ImageGrid) -> RayGrid:
        """Rays at a quarter of the training images' pixel spacing, on any grid; warn if `grid` is finer than these.

        Rays measure the lit area of Gaussians, which does not depend on pixels. For custom training loops the finer one
        of both grids counts: their Gaussians may be finer than the pixels chosen for them.
        """
        own = self.grid
        if self.config.preset == OWN_LOOP:
            own = min(own, grid, key=lambda one: min(one.spacing_m))
        elif any(asked < 0.999 * had for asked, had in zip(grid.resolution_m, own.resolution_m, strict=True)):
            finer, usual = (" × ".join({f"{one:.3g}": 0 for one in of.resolution_m}) + " m" for of in (grid, own))
            warnings.warn(
                f"a resolution of {finer} is finer than the {usual} of the training images, so the images show single "
                "Gaussians rather than the target; ask for no finer one",
                SarsplatWarning,
                stacklevel=3,
            )
        return RayGrid.for_image(own, _EVALUATION_RAYS_PER_PIXEL)

    def sampler(self, ground: str | Float32[np.ndarray, "r c"], speckle: Speckle, scatterers: float) -> Sampler:
        """Return a sampler; raise if the run was learned without speckle."""
        if self.config.surroundings is None and self.config.loss != "speckle":
            raise SarsplatError(
                f"this run was learned without speckle of single images (preset {self.config.preset}, loss "
                f"{self.config.loss}); reconstruct the power of speckled ones with the preset measured or speckled"
            )
        return Sampler(self.model, self._degree, self.grid, ground, speckle, scatterers)

    def masks(self, views: Sequence[View], points: Float32[np.ndarray, "p 3"]) -> UInt8[np.ndarray, "v rows columns"]:
        """Masks of any views, from renderings of the target alone and of the ground alone (`scene_masks`).

        The target are the Gaussians near the points and, if ground was learned, at least one resolution cell above it
        (`without_imitated_ground`). Without learned ground there is no shadow.
        """
        ground = self.model.ground()
        target = without_imitated_ground(self.gaussians, points, self.grid.cell_m, ground)
        return scene_masks(target, ground, views, self.model.as_displaced(self.grid), self._rays(self.grid))

    @property
    def azimuth_offset_deg(self) -> Float64[np.ndarray, " k"] | None:
        offsets = self.snapshot.tensors.get(AZIMUTH_OFFSETS)
        return None if offsets is None else offsets.double().numpy()

    def views_of(self, entries: Sequence[DatasetEntry], train: Dataset) -> tuple[View, ...]:
        passes, corrections = uncertain_passes(train), self._corrections
        if corrections is None:
            return super().views_of(entries, train)
        if corrections.shape != (len(passes), 3):
            raise SarsplatError(f"{train} does not have the {len(corrections)} uncertain passes of the training")
        return corrected_views(entries, passes, corrections)

    @property
    def _corrections(self) -> Float64[np.ndarray, "passes 3"] | None:
        """Corrections of each uncertain pass: axis in two directions, degrees, and relative rate; None without any."""
        corrections = self.snapshot.tensors.get(TURN_CORRECTIONS)
        if corrections is None:
            return None
        if corrections.ndim != 2 or corrections.shape[1] != 3 or not corrections.isfinite().all():
            raise SarsplatError("the checkpoint does not hold corrections of rotations; reconstruct it again")
        return corrections.double().numpy()

    def points(self) -> Float32[np.ndarray, "p 3"]:
        """First returns of rays, or centres, as configured."""
        how, views = self.config.points, self.snapshot.views
        if how.method == "rays" and self.model.levels.coarsest > 1:
            how = replace(how, optical_depth=how.smoothed_depth)
        if views[0].aloft:
            how = replace(how, min_height=_NO_GROUND)
        terrain = self.model.frame.terrain
        points = extract_points(self.gaussians, views, self.grid, how, terrain, self._ground_gamma0)
        return points.astype(np.float32)  # as the file has them

    def normals_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, "p 3"]:
        """Normals from the Gaussians and points around each point (`surface_normals`), in batches."""
        cell_m, normals, point_spacing_m = self.grid.cell_m, np.empty((len(points), 3), np.float32), spacing_m(points)
        for index, inner in parts_of(points, _NORMAL_REACH * cell_m):
            near = points[index]
            towards = self._seen.around(near)[1]
            normals[index[inner]] = surface_normals(near, towards, self.gaussians, cell_m, point_spacing_m)[inner]
        return normals

    def gamma0_at(self, points: Float32[np.ndarray, "p 3"]) -> Float32[np.ndarray, " p"]:
        """Mean γ⁰ of the Gaussians around, weighted by the area that each training view sees."""
        return self._seen.around(points)[0].astype(np.float32)

    @cached_property
    def _seen(self) -> Seen:
        seen = Seen.of(self.gaussians, self.snapshot.views, self.grid)
        return replace(seen, cross_section=seen.cross_section * self.model.unit)

    @property
    def learned(self) -> str:
        return counted(len(self.gaussians), "Gaussian")

    @property
    def facts(self) -> dict[str, str]:
        own = self.config.preset == OWN_LOOP
        made = {"made by": OWN_LOOP} if own else {"preset": self.config.preset, "start": self.config.initialisation}
        region, above = self.model.frame.region, "" if self.model.frame.terrain is None else " above the terrain"
        box = f"{spans(region.low, region.high)} m{above} (--target-box gives another)"
        looked = {} if own else {"looked in": box}
        scattering = {"scattering": self.gaussians.scattering.times(self.model.unit).in_words}
        chosen = {"chosen by": self.config.evidence} if self.config.evidence else {}
        return made | chosen | scattering | looked | self._rotations | self._ground

    @property
    def _rotations(self) -> dict[str, str]:
        """Corrections of the rotation axes and rates of the passes, in words."""
        if (corrections := self._corrections) is None or not corrections.any():
            return {}
        passes = [f"axis by {math.hypot(*of[:2]):.2f}°, rate by {of[2]:+.2%}" for of in corrections]
        return {"corrected rotations": "; ".join(passes[:_MAX_PASSES] + ["…"] * (len(passes) > _MAX_PASSES))}

    @property
    def _ground_gamma0(self) -> float | None:
        """Geometric mean of the learned ground's γ⁰, in the model's unit, at the views' mean log sin θ."""
        ground = self.model.ground()
        if ground is None:
            return None
        gamma0 = float(ground.gamma0.detach().log().mean())
        if ground.exponent is not None:
            sines = [view.look.sine for view in self.snapshot.views]
            gamma0 += float(ground.exponent.detach()) * float(np.log(sines).mean())
        return math.exp(gamma0)

    @property
    def _ground(self) -> dict[str, str]:
        if (gamma0 := self._ground_gamma0) is None:
            return {}
        shape = "a plane" if self.model.frame.terrain is None else "terrain"
        facts = {"ground": f"{shape}, γ⁰ {gamma0 * self.model.unit:.3g} (linear)"}
        for echo in self.model.echoes():
            if isinstance(echo, GroundBounce):
                share = float(echo.reflectivity.detach())
                facts["second bounce"] = f"by way of the ground, which reflects {share:.3g} of the power"
        return facts


def lengths(config: Config, grid: ImageGrid) -> str:
    """Return one line of text: the lengths, in metres, of a reconstruction on this grid."""
    cell_m = grid.cell_m
    scales, rates = scales_m(config, cell_m), config.rates
    wider = ", wider in large scenes" if config.coarsest > 1 else ""
    rays = [
        RayGrid.for_image(grid, count).spacing_m[0] for count in (config.rays_per_pixel, config.fine_rays_per_pixel)
    ]
    ray = f"{rays[0]:.2g} m" if config.fine_from == 1 else f"{rays[0]:.2g}, then {rays[1]:.2g} m"
    return (
        f"lengths from {cell_m:.3g} m resolution cells: start {scales[1]:.2g} m, sizes {scales[0]:.2g} … "
        f"{scales[2]:.2g} m{wider}, steps {rates.means * cell_m:.2g} → {rates.means_end * cell_m:.2g} m, rays {ray}, "
        f"voxels {config.points.voxel * cell_m:.2g} m"
    )
