"""Covariances between the channels of stacks as few real images: a power for each polarisation, and complex pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.gaussians.law_polarimetric import Polarimetric, covariances_between
from sarsplat.gaussians.scattering import Scattering
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.geometry.stack import Stack
from sarsplat.renderer.checks import MAX_OPTICAL_DEPTH
from sarsplat.renderer.constants import MIN_RAY_DEPTH
from sarsplat.renderer.footprints import Projection, Waves
from sarsplat.renderer.steps import attenuate, project, splat, splat_parts

_SAME = 1e-5
"""Of the largest phase per elevation: pairs of passes that differ by less share an image, as even passes do."""

_ANY = View(0.0, 45.0)
"""Phases in the radar's frame are the same from everywhere."""


@dataclass(frozen=True)
class Planes:
    """Expected covariances of the channels of stacks, without noise, and what channels have in common.

    Attributes
    ----------
    powers : Tensor [V, K, rows, columns]
        On the diagonal: β⁰ of each polarisation.
    pairs : Tensor [V, 2 D, rows, columns]
        Beside it, of channels i < j: real and imaginary parts in turn.
    of_channels, of_pairs : tuple of int
        Which of the K are the channels', and which of the D the pairs', in order of rows.
    turns : Tensor [V, P, rows]
        Phases of the channels that grow with range alone, rad.
    """

    powers: Float[Tensor, "v k rows columns"]
    pairs: Float[Tensor, "v d rows columns"]
    of_channels: tuple[int, ...]
    of_pairs: tuple[int, ...]
    turns: Float[Tensor, "v p rows"]

    def whole(self, phases: Float[Tensor, "v p rows columns"] | None = None) -> Complex[Tensor, "v p p rows columns"]:
        """Hermitian matrices, whose channels have `phases` besides."""
        count = len(self.of_channels)
        phases = self.turns[..., None] if phases is None else self.turns[..., None] + phases
        v, _, *size = self.powers.shape
        result = self.powers.new_zeros((count, count, v, *size), dtype=self.powers.dtype.to_complex())
        diagonal = self.powers[:, list(self.of_channels)].transpose(0, 1)
        result[range(count), range(count)] = diagonal.to(result)
        if count > 1:
            first, second = np.triu_indices(count, 1)
            pairs = torch.view_as_complex(self.pairs.unflatten(1, (-1, 2)).movedim(2, -1).contiguous())
            between = phases[:, first] - phases[:, second]
            turned = pairs[:, list(self.of_pairs)] * torch.polar(torch.ones_like(between), between)
            result[first, second] = turned.transpose(0, 1)
            result[second, first] = turned.transpose(0, 1).conj()
        return result.movedim(2, 0)


def lit_planes(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    stacks: Sequence[Stack],
    *,
    rays: RayGrid | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    engine: str = "auto",
) -> tuple[Planes, Float[Tensor, "v n"], Float[Tensor, "v n"]]:
    """`render_covariances`, and of each Gaussian the radar cross-section of power and the lit area, m²."""
    rays = rays or RayGrid.for_image(grid)
    projection = project(gaussians, views, grid, rays=rays, shift=shift, engine=engine)
    depth = projection.optical_depth
    whole = (depth + MIN_RAY_DEPTH * (depth > 0)).clamp(max=MAX_OPTICAL_DEPTH)
    lit_area = attenuate(replace(projection, optical_depth=whole), rays, engine=engine).lit_area
    plan = _Plan.of(tuple(stacks))
    power, shown, real, imaginary, kinds = _sections(gaussians.scattering, projection.amplitudes, lit_area, plan)
    powers = splat(projection.pixels, shown, grid, engine=engine)
    pairs = powers[:, :0]
    if plan.pairs:
        waves = None
        if plan.numbers.any():
            real, imaginary, waves = _turned(gaussians, views, projection, plan.numbers, real, imaginary)
        parts = torch.stack([real, torch.zeros_like(real) if imaginary is None else imaginary], dim=-1).flatten(2)
        pairs = splat_parts(projection.pixels, parts, grid, waves, "area", engine)
    turns = torch.from_numpy(plan.ranges[..., None] * grid.range_m).to(powers)
    return Planes(powers, pairs, kinds, plan.of_pairs, turns), power, lit_area


@dataclass(frozen=True)
class _Plan:
    """Which pairs of the channels of stacks are rendered."""

    names: tuple[str, ...]
    """Polarisation of each channel."""
    pairs: tuple[tuple[int, int], ...]
    """Channels of those that are."""
    of_pairs: tuple[int, ...]
    """Of all pairs i < j, which of those they are."""
    numbers: Float64[np.ndarray, "v d"]
    """By how much more phase per elevation the first of each pair has, rad/m."""
    ranges: Float64[np.ndarray, "v p"]
    """Phase per range of each channel, rad/m."""

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, stacks: tuple[Stack, ...]) -> _Plan:
        names, frame = stacks[0].of_channels, radar_frame(_ANY)
        vectors = np.stack([stack.phase_vectors(_ANY) @ frame.T for stack in stacks])
        elevation = vectors[..., 1]
        same = _SAME * np.ptp(elevation)
        pairs: list[tuple[int, int]] = []
        of_pairs = []
        for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
            number = elevation[:, i] - elevation[:, j]
            for place, (a, b) in enumerate(pairs):
                alike = (names[a], names[b]) == (names[i], names[j])
                if alike and np.abs(elevation[:, a] - elevation[:, b] - number).max() <= same:
                    of_pairs.append(place)
                    break
            else:
                of_pairs.append(len(pairs))
                pairs.append((int(i), int(j)))
        numbers = np.stack([elevation[:, i] - elevation[:, j] for i, j in pairs], 1) if pairs else elevation[:, :0]
        return cls(names, tuple(pairs), tuple(of_pairs), numbers, vectors[..., 2])


def _sections(
    law: Scattering, amplitudes: Float[Tensor, "v n c"], lit_area: Float[Tensor, "v n"], plan: _Plan
) -> tuple[Float[Tensor, "v n"], Float[Tensor, "v n k"], Tensor, Tensor | None, tuple[int, ...]]:
    """Cross-sections, m²: of power, of each polarisation, and of each pair, real and imaginary, all at one place.

    The last is the polarisation of each channel, in order of the second. Imaginary parts are None where all are 0.
    """
    power = amplitudes[..., law.power_channel] * lit_area
    if not isinstance(law, Polarimetric) or not any(plan.names):
        return (
            power,
            power[..., None],
            power[..., None].expand(*power.shape, len(plan.pairs)),
            None,
            (0,) * len(plan.names),
        )
    places = [law.polarisations.index(name) for name in plan.names]
    own = sorted(set(places))
    lit = amplitudes * lit_area[..., None]
    matrices = covariances_between(lit, len(law.polarisations))
    pairs = matrices[..., [places[i] for i, _ in plan.pairs], [places[j] for _, j in plan.pairs]]
    kinds = tuple(own.index(place) for place in places)
    return power, lit[..., [1 + place for place in own]], pairs.real, pairs.imag, kinds


def _turned(
    gaussians: Gaussians,
    views: Sequence[View],
    projection: Projection,
    numbers: Float64[np.ndarray, "v d"],
    real: Float[Tensor, "v n d"],
    imaginary: Float[Tensor, "v n d"] | None,
) -> tuple[Float[Tensor, "v n d"], Float[Tensor, "v n d"], Waves]:
    """Cross-sections of pairs with the phases at the centres of footprints, and how these change across them.

    Given the pixel at the displacement d from the centre of a footprint, scatterers are distributed around μ + K d with
    the covariance Σ − K J Σ, where K = Σ Jᵀ (J Σ Jᵀ + response)⁻¹ and J projects on the imaging plane; of these, only
    the elevation counts. The inverse is that of the footprint.
    """
    means = gaussians.means
    frames = torch.from_numpy(np.stack([radar_frame(view) for view in views])).to(means)  # [V, 3, 3]
    root = rotation_matrix(gaussians.quaternions) * gaussians.scales[:, None]  # Σ is its square
    sides = (frames.flatten(0, 1) @ root.transpose(0, 1).flatten(1)).unflatten(0, (-1, 3)).unflatten(2, (-1, 3))
    x, y, z = sides.unbind(1)  # [V, N, 3] each
    yx, yy, yz = ((y * other).sum(-1) for other in (x, y, z))
    a, b, c = projection.pixels.roots.unbind(-1)
    along, mixed, away = a * a, a * b, b * b + c * c
    slopes = torch.stack([along * yx + mixed * yz, mixed * yx + away * yz], dim=-1)
    variance = (yy - slopes[..., 0] * yx - slopes[..., 1] * yz).clamp(min=0)
    kappa = torch.from_numpy(numbers).to(means)[:, None]
    phase = (frames[:, 1] @ means.T)[..., None] * kappa
    left = torch.exp(variance[..., None] * (-0.5 * kappa * kappa))
    cosine, sine = left * phase.cos(), left * phase.sin()
    waves = Waves(kappa[:, 0].contiguous(), slopes)
    if imaginary is None:
        return real * cosine, real * sine, waves
    return real * cosine - imaginary * sine, real * sine + imaginary * cosine, waves
