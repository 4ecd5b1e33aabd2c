"""Reference renderer: plain torch, any dtype, equation by equation; engines must agree with it.

Dense: it evaluates every Gaussian at every ray and every pixel, so it is meant for small scenes. Numbers in comments
are sections of the model (docs/concepts/image-model.md).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.gaussians import covariance, rotation_matrix
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH, MIN_TRANSMITTANCE
from sarsplat.renderer.echoes.echo import Echo, Sighting, ends_of, left_in_sight, with_echoes
from sarsplat.renderer.rendering import (
    Attenuation,
    Footprints,
    Projection,
    RayMap,
    Rendering,
    Waves,
    deviations,
    footprints_of,
)

_MAX_PAIRS = 1 << 26  # maximum pairs of Gaussians and rays in one view; in float64 about 5 GB and 10 s


def render_reference(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid,
    amplitudes: Float[Tensor, "v n c"] | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    gain: Float[Tensor, " v"] | None = None,
    imaging_weight: str = "area",
    echoes: Sequence[Echo] = (),
    first_return_depth: float | None = None,
) -> Rendering:
    """Render as `sarsplat.render` does."""
    projection = project_reference(gaussians, views, grid, rays=rays, shift=shift)
    in_sight = left_in_sight(echoes, gaussians.means, views, grid, rays, shift)
    if in_sight is not None:
        projection = replace(projection, optical_depth=projection.optical_depth * in_sight)
    wants_ends = any(echo.wants_ray_ends for echo in echoes)
    depth = first_return_depth or 1.0 if wants_ends else first_return_depth
    attenuation = attenuate_reference(projection, rays, first_return_depth=depth)
    amplitudes = projection.amplitudes if amplitudes is None else amplitudes
    cross_sections = amplitudes * attenuation.lit_area[..., None]  # σ = P A_c Σ w
    images = splat_reference(projection.pixels, cross_sections, grid, imaging_weight=imaging_weight)
    ends = ends_of(attenuation.ray_maps) if wants_ends and attenuation.ray_maps else None
    sighting = Sighting(gaussians, views, grid, rays, shift, attenuation.lit_area, ends, None)
    images, returns = with_echoes(images, echoes, sighting)
    return Rendering(
        images if gain is None else images * gain[:, None, None, None],
        cross_sections,
        attenuation.lit_area.detach(),
        None if first_return_depth is None else attenuation.ray_maps,
        echoes=returns,
    )


def project_reference(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, *, rays: RayGrid, shift: Float[Tensor, "v 2"] | None
) -> Projection:
    """Project as `sarsplat.project` does."""
    means = gaussians.means
    spacing = means.new_tensor(rays.spacing_m)
    response = means.new_tensor(grid.response_variance_m2)
    with torch.autocast(means.device.type, enabled=False):  # no rounding to 16 bits
        frames = torch.from_numpy(np.stack([view.look.frame for view in views])).to(means)[:, None]
        mean = (frames @ means[..., None])[..., 0]  # §1: x_r = R_r x_w, [V, N, 3]
        cov = frames @ covariance(gaussians.quaternions, gaussians.scales) @ frames.mT  # [V, N, 3, 3]
        cov_c, cov_i = cov[..., :2, :2], cov[..., ::2, ::2]  # §3: the (x, y) and the (x, z) block
        widened = cov_c + CELL_WIDENING * torch.diag(spacing**2)  # Σ_C'
        roots = _roots(widened)
        kappa = gaussians.optical_depth * (torch.linalg.det(cov_c) / torch.linalg.det(widened)).sqrt()  # κ'
        centers = mean[..., ::2] if shift is None else mean[..., ::2] + shift[:, None]
        pixels = Footprints(centers, _roots(cov_i + torch.diag(response)))  # Σ_I'
        # Σ_C'⁻¹ (Σ_xz, Σ_yz) = Lᵀ L (Σ_xz, Σ_yz)
        u, v = _whitened(cov[..., :2, 2], roots)
        a, b, c = roots.unbind(-1)
        tilt = torch.stack([a * u, b * u + c * v], dim=-1)
        amplitudes = gaussians.amplitudes(-frames[:, 0, 2])  # P(u), §2
    return Projection(Footprints(mean[..., :2], roots), kappa, mean[..., 2].detach(), tilt.detach(), pixels, amplitudes)


def pressed_flat_reference(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, *, shift: Float[Tensor, "v 2"] | None, height_m: float
) -> Footprints:
    """Return footprints on the imaging plane of Gaussians pressed flat onto the plane z = `height_m`."""
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


def attenuate_reference(projection: Projection, rays: RayGrid, *, first_return_depth: float | None) -> Attenuation:
    """Attenuate as `sarsplat.attenuate` does."""
    p = projection
    with torch.autocast(p.optical_depth.device.type, enabled=False):
        by_view = [
            _attenuate_view(*view, rays, first_return_depth)
            for view in zip(p.rays.centers, p.rays.roots, p.optical_depth, p.range_m, p.tilt, strict=True)
        ]
        lit_area = rays.cell_area * torch.stack([weight for weight, _ in by_view])
    return Attenuation(lit_area, None if first_return_depth is None else tuple(ray_map for _, ray_map in by_view))


def splat_reference(
    footprints: Footprints,
    cross_sections: Float[Tensor, "v n c"],
    grid: ImageGrid,
    *,
    waves: Waves | None = None,
    imaging_weight: str = "area",
) -> Float[Tensor, "v c {grid.rows} {grid.columns}"]:
    """Splat as `sarsplat.splat` does; with waves, alternating real and imaginary parts."""
    x, r = (torch.from_numpy(axis).to(cross_sections) for axis in (grid.azimuth_m, grid.range_m))
    pixel = torch.stack(torch.meshgrid(x, r, indexing="xy"), dim=-1)  # [rows, columns, 2]
    images = []
    with torch.autocast(cross_sections.device.type, enabled=False):
        for view, (centers, roots, sigma) in enumerate(
            zip(footprints.centers, footprints.roots, cross_sections, strict=True)
        ):
            d = pixel - centers[:, None, None]
            u, v = _whitened(d, roots[:, None, None])
            q = u**2 + v**2
            weight = torch.exp(-0.5 * q)
            weight = torch.where(q <= IMAGE_CUT, weight, torch.zeros_like(weight)) / (1 - math.exp(-IMAGE_CUT / 2))
            if imaging_weight == "area":
                weight = weight * (roots[:, 0] * roots[:, 2] / (2 * math.pi))[:, None, None]  # 1/(2π √det Σ_I')
            if waves is None:
                images.append(torch.einsum("nc,nyx->cyx", sigma, weight))
                continue
            elevation = (waves.slopes[view][:, None, None] * d).sum(-1)
            turn = torch.exp(1j * elevation[:, None] * waves.numbers[view][:, None, None])  # [N, C, rows, columns]
            complexes = torch.view_as_complex(sigma.unflatten(1, (-1, 2)).contiguous())
            image = torch.einsum("nc,nyx,ncyx->cyx", complexes, weight.to(turn), turn)
            images.append(torch.view_as_real(image).movedim(-1, 1).flatten(0, 1))
    return torch.stack(images)


def _roots(cov: Float[Tensor, "v n 2 2"]) -> Float[Tensor, "v n 3"]:
    """Return (a, b, c) of the factor L = (a b; 0 c) of the inverse covariance LᵀL."""
    xx, xy, yy = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1]
    a = (yy / (xx * yy - xy**2)).sqrt()
    return torch.stack([a, -xy / yy * a, yy.rsqrt()], dim=-1)


def _whitened(d: Float[Tensor, "*n 2"], roots: Float[Tensor, "*m 3"]) -> tuple[Tensor, Tensor]:
    """Return L d."""
    return roots[..., 0] * d[..., 0] + roots[..., 1] * d[..., 1], roots[..., 2] * d[..., 1]


def _attenuate_view(
    centers: Float[Tensor, "n 2"],
    roots: Float[Tensor, "n 3"],
    kappa: Float[Tensor, " n"],
    range_m: Float[Tensor, " n"],
    tilt: Float[Tensor, "n 2"],
    rays: RayGrid,
    first_return_depth: float | None,
) -> tuple[Float[Tensor, " n"], RayMap]:
    """Attenuate one view (§3, pass A): return Σ_ρ w of each Gaussian and the ray map."""
    spacing = torch.tensor(rays.spacing_m, dtype=kappa.dtype, device=kappa.device)
    limit = 2 * torch.log(kappa.detach() / MIN_RAY_DEPTH)
    touched = limit >= 0
    if not bool(touched.any()):
        empty = kappa.new_ones(0, 0)
        return 0 * kappa, RayMap(empty, empty, (0.0, 0.0))

    radius = limit.clamp(min=0).sqrt()[:, None] * deviations(roots.detach())
    low = torch.floor((centers.detach() - radius)[touched].amin(0) / spacing).tolist()
    high = torch.ceil((centers.detach() + radius)[touched].amax(0) / spacing).tolist()
    pairs = len(kappa) * max(high[0] - low[0], 1) * max(high[1] - low[1], 1)
    if not pairs <= _MAX_PAIRS:  # also catches what overflowed
        raise SarsplatError(
            f"the reference would need too many rays at a spacing of {rays.spacing_m} m: {pairs:.3g} pairs of "
            f"Gaussians and rays, where {_MAX_PAIRS:.3g} is the limit; remove distant or wide Gaussians, use coarser "
            "rays, or use engine='cpu'"
        )
    x = (torch.arange(low[0], high[0], dtype=kappa.dtype) + 0.5).to(spacing.device) * spacing[0]
    y = (torch.arange(low[1], high[1], dtype=kappa.dtype) + 0.5).to(spacing.device) * spacing[1]
    rho = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)  # ray positions [rows, columns, 2]

    order = torch.sort(range_m.detach(), stable=True).indices  # front to back; ties by index
    d = rho - centers[order][:, None, None]
    u, v = _whitened(d, roots[order][:, None, None])
    q = u**2 + v**2
    tau = kappa[order][:, None, None] * torch.exp(-0.5 * q)
    tau = torch.where(q <= limit[order][:, None, None], tau, torch.zeros_like(tau))
    before = torch.exp(-(torch.cumsum(tau, dim=0) - tau))  # T_i
    tau = torch.where(before >= MIN_TRANSMITTANCE, tau, torch.zeros_like(tau))
    weight = before * -torch.expm1(-tau)
    transmittance = torch.exp(-tau.sum(0))
    first_return = torch.full_like(transmittance, math.nan)
    if first_return_depth is not None:
        # the range of each Gaussian's densest point on the ray, at the Gaussian where the depth is first reached
        peak = range_m[order][:, None, None] + torch.einsum("nyxi,ni->nyx", d, tilt[order])
        reached = torch.cumsum(tau, dim=0) >= first_return_depth
        first = reached.to(torch.uint8).argmax(dim=0)
        first_return = torch.where(reached.any(0), torch.gather(peak, 0, first[None])[0], first_return).detach()
    ray_map = RayMap(transmittance, first_return, (float(x[0]), float(y[0])))
    return torch.zeros_like(kappa).index_copy(0, order, weight.sum((1, 2))), ray_map
