"""Echo by way of a level, smooth ground: Gaussian–ground and ground–Gaussian.

The way in is the line of sight u, the way out its mirror image M u at the ground, or the reverse. Both are as long as
the way to the foot (x, y, ground) and back, whatever the height: a Gaussian is imaged as if it were pressed flat onto
the ground. The amplitudes of both orders add: four times the power of one.

The lit area of both ways is √(lit(u)·lit(M u)). Along M u the scene is lit as its mirror image is along u: rays pass
the whole scene, which is above the ground, and then the image with the transmittance left. The CPU engine does so in
one call; in the steps of a rendering the scene and its image are one scene of 2 N Gaussians.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Ground, Harmonics
from sarsplat.gaussians.gaussians import check_same_kind
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.renderer.echoes.echo import Echo, Sighting
from sarsplat.renderer.engines.abi import api
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.on_device import by_view
from sarsplat.renderer.engines.passes import NewPass, Pass
from sarsplat.renderer.engines.problem import level_direction
from sarsplat.renderer.engines.stages import Bounce
from sarsplat.renderer.operations import Steps, amplitudes_along, foot
from sarsplat.renderer.rendering import Footprints

_COHERENT = 4.0  # power of two equal amplitudes over that of one


@dataclass(frozen=True)
class GroundBounce(Echo):
    """Return of Gaussians by way of a smooth, level ground, both orders together.

    Parameters
    ----------
    ground : Ground
        Plane that is rendered as the ground.
    reflectivity : Tensor []
        |Γ|², the specularly reflected share of the power, 0 to 1; differentiable.
    amplitudes : Tensor [V, N], optional
        Bistatic γ⁰ of each Gaussian between u and M u in each view, linear power, differentiable; by default its
        scattering law in the direction halfway between, which is level.

    Raises
    ------
    SarsplatError
        If the ground is terrain, or the reflectivity is not one number.
    """

    ground: Ground
    reflectivity: Float[Tensor, ""]
    amplitudes: Float[Tensor, "v n"] | None = None

    way: ClassVar[str] = "by way of the ground"
    wants_ray_ends: ClassVar[bool] = True
    within_bounds: ClassVar[bool] = False  # the mirror image is below

    def __post_init__(self) -> None:
        if isinstance(self.ground.height_m, Terrain):
            raise SarsplatError("the bounce is off a plane, but the ground is terrain; leave out the bounce")
        if not isinstance(self.reflectivity, Tensor) or self.reflectivity.ndim:
            raise SarsplatError(
                "the bounce's reflectivity must be a torch.Tensor of one number, such as torch.tensor(0.5)"
            )

    def check(self, gaussians: Gaussians) -> None:
        own = {"the bounce's reflectivity": self.reflectivity, "the bounce's amplitudes": self.amplitudes}
        check_same_kind({"means": gaussians.means} | own)

    def values(self) -> dict[str, Tensor | None]:
        return {"bounce.reflectivity": self.reflectivity.reshape(1), "bounce.amplitudes": self.amplitudes}

    def visible(self, gaussians: Gaussians) -> Gaussians:
        """Hide Gaussians whose centres are below the ground, as the ground itself does."""
        hidden = gaussians.means[:, 2] < self._height
        return replace(gaussians, optical_depth=gaussians.optical_depth.masked_fill(hidden, 0.0))

    def returned(self, sighting: Sighting) -> Float[Tensor, "v rows columns"]:
        s = sighting
        if self.amplitudes is not None and len(self.amplitudes) != len(s.views):
            raise SarsplatError(f"the bounce's amplitudes are of {len(self.amplitudes)} views, not of {len(s.views)}")
        if s.new_pass is not None and (kernel := s.new_pass()).has("bounce", {}):
            beta0 = self._in_one_call(kernel, s)
        else:
            steps = Steps(s.new_pass)
            cross_sections, footprints = self.parts(s.gaussians, s.views, s.grid, s.rays, shift=s.shift, steps=steps)
            beta0 = steps.splat(footprints, cross_sections[..., None], s.grid)[:, 0]
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return beta0 * self.reflectivity.expand(1, 1, s.grid.columns).expand(-1, s.grid.rows, -1)

    def parts(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        rays: RayGrid,
        *,
        shift: Float[Tensor, "v 2"] | None = None,
        steps: Steps | None = None,
    ) -> tuple[Float[Tensor, "v n"], Footprints]:
        """Return cross-sections by way of a perfectly reflecting ground, m², and their footprints in images."""
        check_unstretched(views)
        steps = steps or Steps(passes_for("auto", gaussians.tensors(), grid))
        amplitudes = _gamma0(steps.new_pass, gaussians, views) if self.amplitudes is None else self.amplitudes
        direct, by_ground = lit_both_ways(steps, gaussians, views, grid, rays, self._height)
        product = direct * by_ground
        positive = product > 0
        lit = product.where(positive, 1.0).sqrt() * positive  # the root's slope at 0 is infinite, and taken as 0
        return lit * amplitudes * _COHERENT, steps.pressed_flat(gaussians, views, grid, shift, self._height)

    def _in_one_call(self, kernel: Pass, s: Sighting) -> Float[Tensor, "v rows columns"]:
        """Return images by an engine, with the lit areas and the ray ends of the rendering."""
        assert s.ends is not None  # wants_ray_ends
        g, (dx, dy), harmonics, amplitudes = s.gaussians, s.rays.spacing_m, None, self.amplitudes
        if amplitudes is None and isinstance(g.scattering, Harmonics):
            harmonics = g.scattering.parameters  # kernels evaluate these themselves
        elif amplitudes is None:
            amplitudes = _gamma0(s.new_pass, g, s.views)
        step = Bounce(kernel, s.views, s.grid, s.rays, g.scattering.p_min)
        step.height_m, step.factor = self._height, _COHERENT
        step.lattices = [
            api.lattice(round(x / dx - 0.5), round(y / dy - 0.5), *size)
            for size, (x, y) in zip(s.ends.sizes, s.ends.origins, strict=True)
        ]
        channel = None if amplitudes is None else amplitudes[..., None]
        moved = foot(g, s.views, s.shift, self._height)
        arrays = g.means, g.quaternions, g.scales, g.optical_depth, harmonics, channel, moved
        return step.of(*arrays, s.ends.transmittance, s.lit_area)[0]

    @property
    def _height(self) -> float:
        assert not isinstance(self.ground.height_m, Terrain)  # rejected
        return self.ground.height_m


def lit_both_ways(
    steps: Steps, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid, height_m: float
) -> tuple[Float[Tensor, "v n"], Float[Tensor, "v n"]]:
    """Return lit areas of Gaussians along u, and by way of the ground along M u, m²."""
    n, p = len(gaussians), steps.project(_with_mirror_image(gaussians, height_m), views, grid, rays=rays)
    if n:
        real, image = p.range_m.split(n, dim=1)
        behind = 1 + (real.amax(1, keepdim=True) - image.amin(1, keepdim=True))  # no digit of the real ones is lost
        p = replace(p, range_m=torch.cat([real, image + behind], 1))
    lit = steps.attenuate(p, rays).lit_area
    return lit[:, :n], lit[:, n:]


def _with_mirror_image(gaussians: Gaussians, height_m: float) -> Gaussians:
    """Append the scene's image in the ground; M R(q) M of the quaternion (w, x, y, z) is (w, −x, −y, z)."""
    g = gaussians
    flipped = g.means * g.means.new_tensor([1.0, 1.0, -1.0]) + g.means.new_tensor([0.0, 0.0, 2 * height_m])
    turned = g.quaternions * g.quaternions.new_tensor([1.0, -1.0, -1.0, 1.0])
    return Gaussians(
        torch.cat([g.means, flipped]),
        torch.cat([g.quaternions, turned]),
        g.scales.repeat(2, 1),
        g.optical_depth.repeat(2),
        Harmonics(g.means.new_zeros(2 * len(g), 1)),  # unused
    )


def _gamma0(new_pass: NewPass | None, gaussians: Gaussians, views: Sequence[View]) -> Float[Tensor, "v n"]:
    """Return the scattering law between u and M u."""
    middles = by_view(level_direction, views, gaussians.means.dtype, gaussians.means.device)
    return amplitudes_along(new_pass, gaussians, middles)[..., gaussians.scattering.power_channel]
