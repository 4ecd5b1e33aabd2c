"""The yardstick: the same images by pair lists in plain float32 torch, differentiated by autograd, on all cores."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.gaussians import covariance
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.renderer.constants import CELL_WIDENING, IMAGE_CUT, MIN_RAY_DEPTH, MIN_TRANSMITTANCE


def render_naive(gaussians: Gaussians, views: list[View], grid: ImageGrid, rays: RayGrid) -> Tensor:
    """β⁰ [V, rows, columns]; agrees with `sarsplat.render` to float32."""
    covariances = covariance(gaussians.quaternions, gaussians.scales)
    return torch.stack([_view(gaussians, covariances, view, grid, rays) for view in views])


@torch.no_grad()
def count_pairs(gaussians: Gaussians, view: View, grid: ImageGrid, rays: RayGrid) -> dict[str, int]:
    """Pairs inside the footprints on each plane, those behind the end of a ray included; on the CPU, in portions."""
    frame = torch.from_numpy(radar_frame(view)).float()
    pairs = {"attenuation": 0, "imaging": 0}
    for part in range(0, len(gaussians), 20_000):
        mean, quaternions, scales, depth = (
            tensor[part : part + 20_000].cpu()
            for tensor in (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.optical_depth)
        )
        mean, cov = mean @ frame.T, frame @ covariance(quaternions, scales) @ frame.T
        pairs["attenuation"] += len(_ray_pairs(mean, cov, depth, rays)[1])
        pairs["imaging"] += len(_pixel_pairs(mean, cov, grid)[1])
    return pairs


def _view(gaussians: Gaussians, covariances: Tensor, view: View, grid: ImageGrid, rays: RayGrid) -> Tensor:
    frame = torch.from_numpy(radar_frame(view)).float()
    mean = gaussians.means @ frame.T
    order = torch.argsort(mean[:, 2].detach(), stable=True)  # from here on Gaussians are front to back
    mean, cov = mean[order], (frame @ covariances @ frame.T)[order]
    gamma0 = gaussians.gamma0(-frame[2:])[0][order]

    kappa, who, where, q = _ray_pairs(mean, cov, gaussians.optical_depth[order], rays)

    where, by_ray = torch.sort(where, stable=True)
    who, q = who[by_ray], q[by_ray]
    tau = kappa[who] * torch.exp(-0.5 * q)
    total = torch.cumsum(tau.double(), 0)  # over all rays: float32 would not do
    _, counts = torch.unique_consecutive(where, return_counts=True)
    first = torch.cumsum(counts, 0) - counts
    before = total - tau
    before = (before - torch.repeat_interleave(before[first], counts)).float()
    kept = before.detach() <= -math.log(MIN_TRANSMITTANCE)
    weight = torch.where(kept, torch.exp(-before) * -torch.expm1(-tau), 0.0)
    cross_section = gamma0 * rays.cell_area * torch.zeros_like(kappa).index_add(0, who, weight)

    cov_i, who, where, q = _pixel_pairs(mean, cov, grid)
    norm = 2 * math.pi * math.prod(grid.spacing_m) * (1 - math.exp(-IMAGE_CUT / 2)) * _det(cov_i).sqrt()
    splat = (cross_section / norm)[who] * torch.exp(-0.5 * q)
    return torch.zeros(grid.rows * grid.columns).index_add(0, where, splat).view(grid.rows, grid.columns)


def _ray_pairs(mean: Tensor, cov: Tensor, depth: Tensor, rays: RayGrid) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Optical depth κ' of every Gaussian, and its pairs with rays."""
    spacing = torch.tensor(rays.spacing_m)
    cov_c = cov[:, :2, :2] / (spacing[:, None] * spacing)  # in ray cells
    wide = cov_c + CELL_WIDENING * torch.eye(2)
    kappa = depth * (_det(cov_c) / _det(wide)).clamp(min=0).sqrt()
    limit = 2 * torch.log(kappa.detach() / MIN_RAY_DEPTH)
    center = mean[:, :2] / spacing - 0.5
    reach = (limit.clamp(min=0)[:, None] * torch.diagonal(wide.detach(), dim1=1, dim2=2)).sqrt()
    low = torch.floor((center.detach() - reach).amin(0))
    size = (torch.ceil((center.detach() + reach).amax(0)) - low + 1).long()
    return kappa, *_pairs(center - low, wide, limit, int(size[0]), int(size[1]))


def _pixel_pairs(mean: Tensor, cov: Tensor, grid: ImageGrid) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Covariance of every Gaussian in pixels, the response included, and its pairs with pixels."""
    pixel, image_center = torch.tensor(grid.spacing_m), torch.tensor(grid.center_m)
    response = torch.diag(torch.tensor(grid.response_variance_m2))
    cov_i = (cov[:, [0, 2]][:, :, [0, 2]] + response) / (pixel[:, None] * pixel)
    half = torch.tensor([(grid.columns - 1) / 2, (grid.rows - 1) / 2])
    center = (mean[:, [0, 2]] - image_center) / pixel + half
    limit = torch.full_like(center[:, 0].detach(), IMAGE_CUT)
    return cov_i, *_pairs(center, cov_i, limit, grid.columns, grid.rows)


def _det(m: Tensor) -> Tensor:
    return m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] ** 2


def _pairs(center: Tensor, cov: Tensor, limit: Tensor, columns: int, rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussian, lattice point and squared Mahalanobis distance of every pair inside a footprint."""
    with torch.no_grad():
        reach = (limit.clamp(min=0)[:, None] * torch.diagonal(cov, dim1=1, dim2=2)).sqrt()
        first = torch.ceil(center - reach).clamp(min=0).long()
        last = torch.minimum(torch.floor(center + reach).long(), torch.tensor([columns - 1, rows - 1]))
        width = torch.where((limit >= 0)[:, None], last - first + 1, 0).clamp(min=0)
        count = width.prod(1)
        who = torch.repeat_interleave(torch.arange(len(center)), count)
        offset = torch.arange(len(who)) - torch.repeat_interleave(torch.cumsum(count, 0) - count, count)
        x = first[who, 0] + offset % width[who, 0]
        y = first[who, 1] + offset // width[who, 0]
        inside = _distance(center, cov, who, x, y) <= limit[who]
        who, x, y = who[inside], x[inside], y[inside]
    return who, y * columns + x, _distance(center, cov, who, x, y)


def _distance(center: Tensor, cov: Tensor, who: Tensor, x: Tensor, y: Tensor) -> Tensor:
    conic = torch.stack([cov[:, 1, 1], -2 * cov[:, 0, 1], cov[:, 0, 0]], 1) / _det(cov)[:, None]
    a, b, c = conic[who].unbind(1)
    dx, dy = x - center[who, 0], y - center[who, 1]
    return (a * dx + b * dy) * dx + c * dy * dy
