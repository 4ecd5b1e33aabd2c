"""DSR: a closed mesh fitted to images and masks by gradient descent (docs/concepts/baselines-dsr.md)."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from msgspec import Meta
from scipy.special import gammaincinv
from torch import Tensor

from sarsplat.baselines.baseline import Baseline, BaselineConfig, Scene
from sarsplat.baselines.mesh_renderer import Layers, MeshRenderer
from sarsplat.baselines.meshes import cube_sphere, flatten_loss, icosphere, iou_loss, laplacian_loss, ordered_sum
from sarsplat.baselines.method import BaselineMethod
from sarsplat.errors import SarsplatError
from sarsplat.geometry import SHADOW, TARGET, View
from sarsplat.settings.kinds import Count, NotNegative, Positive

_HALF_FIELD, _DEPTH_RANGE = 1.58, 99.0
"""Units of √σ and γ, in longest sides of the target: in usual scenes of soft rasterisation, an object of side 1 is in a
field of view of ±1.58 (±30° at distance 2.73), between depths of 1 and 100."""

_DIMMEST = 1e-5  # power added before roots are taken, relative to the brightest: −50 dB
_START_GAMMA0 = 0.01  # initial γ⁰ of the faces, relative to the brightest power: −20 dB
_START_GROUND, _START_FLOOR = 1.0, 0.1  # initial γ⁰ of the ground, and noise floor, relative to `Scene.unit`
Softness = Annotated[float, Meta(ge=1e-6, le=1)]
Momentum = Annotated[float, Meta(ge=0, le=0.9999)]


@dataclass(frozen=True)
class DsrConfig(BaselineConfig):
    """Settings of DSR."""

    vertices: Literal[642, 1352] = 642
    """Number of vertices of the template."""
    sigma: Softness = 1.2e-5
    """σ of the coverage, in squares of 1.58 longest sides of the target's box: √σ is the softness of edges."""
    gamma: Softness = 1e-4
    """Depth over which the visibility of a hidden face falls by 1/e, in 99 longest sides of the box."""
    laplacian: NotNegative = 0.3
    flatten: NotNegative = 3e-4
    lit: NotNegative = 1.0
    shadow: NotNegative = 1.0
    image: NotNegative = 1.0
    """Weights of the losses."""
    iterations: Count = 2000
    views_per_step: Count = 4
    learning_rate: Positive = 0.01
    """Learning rate of the vertices, longest sides of the target's box; it falls tenfold in the whole training."""
    scattering_rate: Positive = 0.03
    """Learning rate of the logarithms of scattering, ground and noise; it falls tenfold, too."""
    betas: tuple[Momentum, Momentum] = (0.5, 0.99)
    """β₁ and β₂ of Adam."""


class Dsr(Baseline):
    """Differentiable SAR renderer on a scene, which needs masks that show the target."""

    faces: Tensor
    edges: Tensor
    flaps: Tensor
    start: Tensor
    masks: Tensor
    log_ground: torch.nn.Parameter | None
    log_floor: torch.nn.Parameter | None

    def __init__(self, scene: Scene, config: DsrConfig) -> None:
        super().__init__(scene, config)
        template = icosphere(8) if config.vertices == 642 else cube_sphere(15)
        sides = scene.high_m - scene.low_m
        self._longest_m = float(sides.max())
        self._center_m = (scene.low_m + scene.high_m) / 2
        self.register_buffer("start", torch.from_numpy(template.vertices * sides / 2 / self._longest_m).float())
        for name in ("faces", "edges", "flaps"):
            self.register_buffer(name, torch.from_numpy(getattr(template, name)), persistent=False)
        self.register_buffer("masks", _checked_masks(scene), persistent=False)
        self.moved = torch.nn.Parameter(torch.zeros_like(self.start))
        self.log_gamma0 = torch.nn.Parameter(
            torch.full((len(template.faces),), math.log(_START_GAMMA0 * scene.brightest), dtype=torch.float32)
        )
        self.log_ground = self.log_floor = None
        if scene.ground:
            self.log_ground = torch.nn.Parameter(torch.tensor(math.log(_START_GROUND), dtype=torch.float32))
            self.log_floor = torch.nn.Parameter(torch.tensor(math.log(_START_FLOOR), dtype=torch.float32))
        self._median = 1.0 if scene.looks is None else float(gammaincinv(scene.looks, 0.5)) / scene.looks
        softness_m = math.sqrt(config.sigma) * _HALF_FIELD * self._longest_m
        self.renderer = MeshRenderer(scene.grid, softness_m, config.gamma * _DEPTH_RANGE * self._longest_m)

    def loss(
        self, chosen: Int64[Tensor, " v"], images: Float[Tensor, "v rows columns"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Mean over the images of the losses of masks and amplitudes, plus regularisers of the mesh.

        The loss of amplitudes is the sum of absolute differences over the sum in the target's mask. Its minimum is at
        the median, so with speckle the rendered mean power is converted to the median.
        """
        config, points = self.config, self._points()
        dimmest, least = _DIMMEST * self.scene.brightest, math.sqrt(self.scene.brightest)
        total = points.new_zeros(())
        for index, power in zip(chosen.tolist(), images, strict=True):
            view, mask = self.scene.views[index], self.masks[index]
            layers = self.layers(view, points)
            target, shadow = ((mask == kind).to(points.dtype) for kind in (TARGET, SHADOW))
            total = total + config.lit * iou_loss(layers.lit, target)
            if bool(shadow.any()):  # without ground, the shadow is unknown
                total = total + config.shadow * iou_loss(layers.shadow, shadow)
            true = (power + dimmest).sqrt()
            error = ((self._median * self._with_ground(layers, view) + dimmest).sqrt() - true).abs()
            total = total + config.image * ordered_sum(error) / ordered_sum(true * target).clamp(min=least)
        shape = self.start + self.moved
        smooth = config.laplacian * laplacian_loss(shape, self.edges)
        flat = config.flatten * flatten_loss(shape, self.faces, self.flaps)
        return total / len(chosen) + smooth + flat

    def optimiser(self) -> torch.optim.Adam:
        others = [one for name, one in self.named_parameters() if name != "moved"]
        groups: list[dict[str, Any]] = [{"params": [self.moved]}, {"params": others, "lr": self.config.scattering_rate}]
        return torch.optim.Adam(groups, self.config.learning_rate, betas=self.config.betas)

    def image(self, view: View) -> Float[Tensor, "rows columns"]:
        """β⁰ of target, ground and noise in units of `Scene.unit`, linear power, row 0 near range."""
        return self._with_ground(self.layers(view), view)

    def layers(self, view: View, points: Float[Tensor, "n 3"] | None = None) -> Layers:
        """Layers of the mesh, or of one with other vertices, in a view, without ground and noise."""
        points = self._points() if points is None else points
        return self.renderer.layers(points, self.faces, self.log_gamma0.exp(), view)

    def surface(self) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
        return self._points().detach().double().cpu().numpy(), self.faces.cpu().numpy()

    def _points(self) -> Float[Tensor, "n 3"]:
        """Vertices, m, world frame."""
        points = self.moved.new_tensor(self._center_m) + self._longest_m * (self.start + self.moved)
        if self.scene.views[0].aloft:
            return points
        return torch.cat([points[:, :2], points[:, 2:].clamp(min=0)], dim=1)  # invisible below the ground

    def _with_ground(self, layers: Layers, view: View) -> Float[Tensor, "rows columns"]:
        if self.log_ground is None or self.log_floor is None:
            return layers.target
        ground = view.look.beta0_of_gamma0(self.log_ground.exp())
        return layers.target + ground * (1 - layers.hidden) + self.log_floor.exp()


def _checked_masks(scene: Scene) -> Tensor:
    if scene.masks is None:
        raise SarsplatError(
            "DSR learns from masks of the lit target and of its shadow, but masks is None; give their folder "
            "(`sarsplat simulate --masks` makes one), or choose another method"
        )
    if not (scene.masks == TARGET).any():
        raise SarsplatError("no mask shows the target (1), so DSR has nothing to learn from; give masks that do")
    return torch.from_numpy(scene.masks.copy())


METHOD = BaselineMethod(
    "dsr",
    "DSR",
    "a closed mesh",
    "sum of the losses of both masks and of the image, and of what keeps the mesh smooth",
    DsrConfig(),
    Dsr,
    takes=frozenset({"masks"}),
)
