"""The echo by way of the ground: Gaussian–ground and ground–Gaussian, off a level, smooth ground.

The way in is the line of sight u, the way out its mirror image M u at the ground, or the reverse. Both are as long as
the way to the foot (x, y, ground) and back, whatever the height: a Gaussian is imaged as if it were pressed flat onto
the ground. The amplitudes of both orders add: four times the power of one.

What returns is lit both ways. Along M u the scene is seen as its mirror image is along u: rays go on through the image
with what is left of them behind the scene, for all of that is before the ground. The CPU engine does so in one call; to
the steps of a rendering the scene and its image are one scene of 2 N Gaussians. The area of both ways is
√(lit(u)·lit(M u)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.gaussians.ground import Ground
from sarsplat.geometry import ImageGrid, RayGrid, Terrain, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.renderer.echoes.echo import Echo, Sighting
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.chosen_views import by_view
from sarsplat.renderer.engines.passes import NewPass
from sarsplat.renderer.engines.problem import level_direction
from sarsplat.renderer.footprints import Footprints, footprints_of
from sarsplat.renderer.lobes import amplitudes_along
from sarsplat.renderer.one_by_one import Steps
from sarsplat.renderer.operations import bounced_with, pressed_flat_with

_COHERENT = 4.0
"""Power of two equal amplitudes over that of one."""


@dataclass(frozen=True)
class GroundBounce(Echo):
    """What Gaussians return by way of a smooth, level ground, both orders together.

    Parameters
    ----------
    ground : Ground
        Where the ground is: a plane, the one that is rendered.
    reflectivity : Tensor []
        |Γ|², the share of the power that it reflects like a mirror, 0 to 1; differentiable.
    amplitudes : Tensor [V, N], optional
        What each Gaussian returns per lit area between u and M u in each view, linear power; otherwise what its
        scattering law says of the direction in the middle, which is level. Differentiable.

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
        like = gaussians.means
        for name, tensor in (("reflectivity", self.reflectivity), ("amplitudes", self.amplitudes)):
            if tensor is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
                raise SarsplatError(
                    f"the bounce's {name} is {tensor.dtype} on {tensor.device} but means is {like.dtype} on "
                    f"{like.device}; use one floating dtype and one device for all tensors"
                )

    def values(self) -> dict[str, Tensor | None]:
        return {"bounce.reflectivity": self.reflectivity.reshape(1), "bounce.amplitudes": self.amplitudes}

    def visible(self, gaussians: Gaussians) -> Gaussians:
        """Those whose centres are above the ground, as for the ground itself."""
        hidden = gaussians.means[:, 2] < self._height
        return replace(gaussians, optical_depth=gaussians.optical_depth.masked_fill(hidden, 0.0))

    def seen(self, sighting: Sighting) -> Float[Tensor, "v rows columns"]:
        """As if the ground reflected everything."""
        s = sighting
        if self.amplitudes is not None and len(self.amplitudes) != len(s.views):
            raise SarsplatError(f"the bounce's amplitudes are of {len(self.amplitudes)} views, not of {len(s.views)}")
        if s.new_pass is not None and (kernel := s.new_pass()).has("bounce", {}):
            check_unstretched(s.views)
            assert s.ends is not None  # asked for
            return bounced_with(
                kernel,
                s.gaussians,
                s.views,
                s.grid,
                rays=s.rays,
                amplitudes=self._amplitudes(s),
                shift=s.shift,
                lit_area=s.lit_area,
                ends=s.ends,
                height_m=self._height,
                factor=_COHERENT,
            )
        steps = _Steps(s.new_pass, s.cuts)
        sections, places = self._parts(steps, s.gaussians, s.views, s.grid, s.rays, s.shift)
        return steps.splat(places, sections[..., None], s.grid)[:, 0]

    def returned(
        self,
        seen: Float[Tensor, "v rows columns"],
        views: Sequence[View],
        grid: ImageGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Float[Tensor, "v rows columns"]:
        # expanded, so that its gradient is summed column by column: to one number, torch would split it by threads
        return seen * self.reflectivity.expand(1, 1, grid.columns).expand(-1, grid.rows, -1)

    def parts(
        self, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid
    ) -> tuple[Float[Tensor, "v n"], Footprints]:
        """What each Gaussian returns by way of a ground that reflects everything, m², and where images show it."""
        steps = _Steps(passes_for("auto", gaussians.tensors(), grid), cuts=True)
        return self._parts(steps, gaussians, views, grid, rays, None)

    def _parts(
        self,
        steps: _Steps,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        rays: RayGrid,
        shift: Float[Tensor, "v 2"] | None,
    ) -> tuple[Float[Tensor, "v n"], Footprints]:
        check_unstretched(views)
        amplitudes = _gamma0(steps.new_pass, gaussians, views) if self.amplitudes is None else self.amplitudes
        direct, by_ground = lit_both_ways(steps, gaussians, views, grid, rays, self._height)
        both = direct * by_ground
        some = both > 0
        lit = both.where(some, 1.0).sqrt() * some  # the root's slope at 0 is infinite, and taken as 0
        return lit * amplitudes * _COHERENT, steps.feet(gaussians, views, grid, self._height, shift)

    def _amplitudes(self, s: Sighting) -> Float[Tensor, "v n 1"] | None:
        """None for harmonics, which engines evaluate themselves."""
        if self.amplitudes is None and isinstance(s.gaussians.scattering, Harmonics):
            return None
        return (_gamma0(s.new_pass, s.gaussians, s.views) if self.amplitudes is None else self.amplitudes)[..., None]

    @property
    def _height(self) -> float:
        assert not isinstance(self.ground.height_m, Terrain)  # refused
        return self.ground.height_m


class _Steps(Steps):
    """Those of a bounce, too."""

    def feet(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        grid: ImageGrid,
        height_m: float,
        shift: Float[Tensor, "v 2"] | None,
    ) -> Footprints:
        if self.new_pass is None:
            return feet(gaussians, views, grid, height_m, shift)
        return pressed_flat_with(self.new_pass, gaussians, views, grid, shift=shift, height_m=height_m)


def lit_both_ways(
    steps: Steps, gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid, height_m: float
) -> tuple[Float[Tensor, "v n"], Float[Tensor, "v n"]]:
    """Areas over which Gaussians are seen along u, and by way of the ground along M u, m²."""
    n, p = len(gaussians), steps.project(_with_mirror_image(gaussians, height_m), views, grid, rays)
    if n:
        real, image = p.range_m.split(n, dim=1)
        behind = 1 + (real.amax(1, keepdim=True) - image.amin(1, keepdim=True))  # no digit of the real ones is lost
        p = replace(p, range_m=torch.cat([real, image + behind], 1))
    lit = steps.lit_area(p, rays)
    return lit[:, :n], lit[:, n:]


def feet(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, height_m: float, shift: Float[Tensor, "v 2"] | None
) -> Footprints:
    """On the imaging plane, of Gaussians pressed flat onto a level ground."""
    means = gaussians.means
    gradients = torch.from_numpy(np.stack([view.look.gradients for view in views])).to(means)  # [V, 2, 3]
    centers = means[:, :2] @ gradients[:, :, :2].mT + gradients[:, None, :, 2] * height_m
    if shift is not None:
        centers = centers + shift[:, None]
    (along, across, _), ((p, q), (r, s)) = (
        (rotation_matrix(gaussians.quaternions) * gaussians.scales[:, None]).unbind(1),
        (row.unbind(1) for row in gradients[:, :, :2, None].unbind(1)),
    )
    xx, xy, yy = along.square().sum(1), (along * across).sum(1), across.square().sum(1)
    var_azimuth, var_range = (a * a * xx + 2 * a * b * xy + b * b * yy for a, b in ((p, q), (r, s)))
    both = p * r * xx + (p * s + q * r) * xy + q * s * yy
    # of a needle, a difference of products would lose the digits that a sum of squares keeps
    flat = (p * s - q * r).square() * torch.linalg.cross(along, across).square().sum(1)
    return footprints_of(centers, (var_azimuth, both, var_range), flat, grid)


def _with_mirror_image(gaussians: Gaussians, height_m: float) -> Gaussians:
    """The scene, and after it its image in the ground; M R(q) M of the quaternion (w, x, y, z) is (w, −x, −y, z)."""
    g = gaussians
    flipped = g.means * g.means.new_tensor([1.0, 1.0, -1.0]) + g.means.new_tensor([0.0, 0.0, 2 * height_m])
    turned = g.quaternions * g.quaternions.new_tensor([1.0, -1.0, -1.0, 1.0])
    return Gaussians(
        torch.cat([g.means, flipped]),
        torch.cat([g.quaternions, turned]),
        g.scales.repeat(2, 1),
        g.optical_depth.repeat(2),
        Harmonics(g.means.new_zeros(2 * len(g), 1)),  # nobody asks
    )


def _gamma0(new_pass: NewPass | None, gaussians: Gaussians, views: Sequence[View]) -> Float[Tensor, "v n"]:
    """What Gaussians return between u and M u."""
    middles = by_view(level_direction, views, gaussians.means.dtype, gaussians.means.device)
    return amplitudes_along(new_pass, gaussians, middles)[..., gaussians.scattering.power_channel]
