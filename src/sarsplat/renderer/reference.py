"""The reference renderer: plain torch, any dtype, equation by equation. It is the judge, not the engine.

Dense: every Gaussian meets every ray and every pixel, so it is meant for small scenes. Numbers in comments are
sections of the model (docs/conventions.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import covariance
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH, MIN_TRANSMITTANCE
from sarsplat.renderer.rendering import RayMap, Rendering

_UNCUT_RADIUS = 9.0
"""Without cuts the lattice reaches this many standard deviations: e⁻⁴⁰ is below float64's resolution."""

_MOST_PAIRS = 1 << 26
"""Of Gaussians and rays in one view; in float64 they take about 5 GB and 10 s."""


def render_reference(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid | None = None,
    gamma0: Float[Tensor, "v n"] | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    gain: Float[Tensor, " v"] | None = None,
    imaging_weight: str = "area",
    first_return_depth: float | None = None,
    cuts: bool = True,
) -> Rendering:
    """Render as `sarsplat.render` does, slowly and by the book.

    `cuts=False` takes off the footprint cuts and the early stop, so that finite differences are valid; everything else
    is documented at `sarsplat.render`.
    """
    rays = rays or RayGrid.for_image(grid)
    means = gaussians.means
    images, cross_sections, lit_areas, ray_maps = [], [], [], []
    with torch.autocast(means.device.type, enabled=False):  # a judge does not round to 16 bits
        sigma_world = covariance(gaussians.quaternions, gaussians.scales)
        for v, view in enumerate(views):
            frame = torch.as_tensor(radar_frame(view), dtype=means.dtype, device=means.device)
            mean_r = means @ frame.T  # §1: x_r = R_r x_w
            cov_r = frame @ sigma_world @ frame.T
            scattered = gaussians.gamma0(-frame[2:])[0] if gamma0 is None else gamma0[v]  # P(u), §2
            weight, transmittance, ray_map = _attenuate(
                mean_r, cov_r, gaussians.optical_depth, rays, cuts, first_return_depth
            )
            lit_area = rays.cell_area * weight
            cross_section = scattered * lit_area  # σ = P A_c Σ w
            offset = shift[v] if shift is not None else means.new_zeros(2)
            image = _image(mean_r, cov_r, cross_section, offset, grid, imaging_weight, cuts)
            images.append(image if gain is None else image * gain[v])
            cross_sections.append(cross_section)
            lit_areas.append(lit_area.detach())
            if ray_map is not None:
                ray_maps.append(RayMap(transmittance, *ray_map))
    return Rendering(
        torch.stack(images),
        torch.stack(cross_sections),
        torch.stack(lit_areas),
        tuple(ray_maps) if first_return_depth is not None else None,
    )


def _attenuate(
    mean_r: Float[Tensor, "n 3"],
    cov_r: Float[Tensor, "n 3 3"],
    kappa: Float[Tensor, " n"],
    rays: RayGrid,
    cuts: bool,
    first_return_depth: float | None,
) -> tuple[
    Float[Tensor, " n"],
    Float[Tensor, "rows columns"],
    tuple[Float[Tensor, "rows columns"], tuple[float, float]] | None,
]:
    """Pass A (§3): Σ_ρ w per Gaussian [N], T_end per ray [rows, columns], and the first-return map on request."""
    spacing = torch.tensor(rays.spacing_m, dtype=mean_r.dtype, device=mean_r.device)
    mean_c, cov_c = mean_r[:, :2], cov_r[:, :2, :2]
    widened = cov_c + CELL_WIDENING * torch.diag(spacing**2)  # Σ_C'
    kappa_ray = kappa * (torch.linalg.det(cov_c) / torch.linalg.det(widened)).sqrt()  # κ'
    limit = 2 * torch.log(kappa_ray.detach() / MIN_RAY_DEPTH) if cuts else torch.full_like(kappa, _UNCUT_RADIUS**2)
    touched = limit >= 0
    if not bool(touched.any()):
        empty = mean_r.new_ones(0, 0)
        return 0 * kappa, empty, (empty, (0.0, 0.0)) if first_return_depth is not None else None

    radius = (limit.clamp(min=0)[:, None] * torch.diagonal(widened.detach(), dim1=1, dim2=2)).sqrt()
    low = torch.floor((mean_c.detach() - radius)[touched].amin(0) / spacing).tolist()
    high = torch.ceil((mean_c.detach() + radius)[touched].amax(0) / spacing).tolist()
    pairs = len(kappa) * max(high[0] - low[0], 1) * max(high[1] - low[1], 1)
    if not pairs <= _MOST_PAIRS:  # also catches what overflowed
        raise SarsplatError(
            f"the reference would need too many rays at a spacing of {rays.spacing_m} m: {pairs:.3g} pairs of "
            f"Gaussians and rays, of which it takes {_MOST_PAIRS:.3g}; remove far and wide Gaussians, take coarser "
            "rays, or use engine='cpu'"
        )
    x = (torch.arange(low[0], high[0], dtype=mean_r.dtype) + 0.5).to(spacing.device) * spacing[0]
    y = (torch.arange(low[1], high[1], dtype=mean_r.dtype) + 0.5).to(spacing.device) * spacing[1]
    rho = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)  # ray positions [rows, columns, 2]

    order = torch.sort(mean_r[:, 2].detach(), stable=True).indices  # front to back; ties by index
    d = rho - mean_c[order][:, None, None, :]
    inverse = torch.linalg.inv(widened)[order]
    q = torch.einsum("nyxi,nij,nyxj->nyx", d, inverse, d)
    tau = kappa_ray[order][:, None, None] * torch.exp(-0.5 * q)
    if cuts:
        tau = torch.where(q <= limit[order][:, None, None], tau, torch.zeros_like(tau))
    before = torch.exp(-(torch.cumsum(tau, dim=0) - tau))  # T_i
    if cuts:
        tau = torch.where(before >= MIN_TRANSMITTANCE, tau, torch.zeros_like(tau))
    weight = before * -torch.expm1(-tau)
    transmittance = torch.exp(-tau.sum(0))

    ray_map = None
    if first_return_depth is not None:
        # the range of each Gaussian's densest point on the ray, at the Gaussian where the depth is first reached
        slope = torch.einsum("nij,nj->ni", inverse, cov_r[order][:, :2, 2])
        peak = mean_r[order][:, 2, None, None] + torch.einsum("nyxi,ni->nyx", d, slope)
        reached = torch.cumsum(tau, dim=0) >= first_return_depth
        first = reached.to(torch.uint8).argmax(dim=0)
        found = torch.gather(peak, 0, first[None])[0]
        found = torch.where(reached.any(0), found, torch.full_like(found, math.nan))
        ray_map = (found.detach(), (float(x[0]), float(y[0])))
    return torch.zeros_like(kappa).index_copy(0, order, weight.sum((1, 2))), transmittance, ray_map


def _image(
    mean_r: Float[Tensor, "n 3"],
    cov_r: Float[Tensor, "n 3 3"],
    cross_section: Float[Tensor, " n"],
    shift: Float[Tensor, " 2"],
    grid: ImageGrid,
    imaging_weight: str,
    cuts: bool,
) -> Float[Tensor, "{grid.rows} {grid.columns}"]:
    """Pass B (§3): β⁰ [rows, columns] of one view, before the gain."""
    response = mean_r.new_tensor(grid.resolution_m) ** 2 / (8 * math.log(2))
    cov_i = cov_r[:, [0, 2]][:, :, [0, 2]] + torch.diag(response)  # Σ_I'
    x, r = (torch.from_numpy(axis).to(mean_r) for axis in (grid.azimuth_m, grid.range_m))
    pixel = torch.stack(torch.meshgrid(x, r, indexing="xy"), dim=-1)  # [rows, columns, 2]
    e = pixel - (mean_r[:, [0, 2]] + shift)[:, None, None, :]
    q = torch.einsum("nyxi,nij,nyxj->nyx", e, torch.linalg.inv(cov_i), e)
    splat = torch.exp(-0.5 * q)
    if cuts:
        splat = torch.where(q <= IMAGE_CUT, splat, torch.zeros_like(splat)) / (1 - math.exp(-IMAGE_CUT / 2))
    if imaging_weight == "area":
        splat = splat / (2 * math.pi * torch.linalg.det(cov_i).sqrt())[:, None, None]
    return torch.einsum("n,nyx->yx", cross_section, splat)
