"""Covariances between the channels of stacks as few real images: a power for each polarisation, and complex pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from sarsplat.gaussians import MAX_OPTICAL_DEPTH, Gaussians
from sarsplat.gaussians.law_polarimetric import Polarimetric, covariances_between
from sarsplat.gaussians.scattering import Scattering
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.stack import Stack
from sarsplat.renderer.constants import MIN_RAY_DEPTH
from sarsplat.renderer.elevations import elevated
from sarsplat.renderer.footprints import Waves
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
    pixels = projection.pixels
    if plan.numbers.any():
        numbers = plan.numbers if len(set(kinds)) > 1 else np.insert(plan.numbers, 0, 0.0, axis=1)  # with the power
        parts, slopes = elevated(gaussians, views, pixels, numbers, real, imaginary, engine)
        waves = Waves(torch.from_numpy(numbers).to(slopes), slopes)
        pairs = splat_parts(pixels, parts, grid, waves, "area", engine)
        if len(set(kinds)) > 1:
            powers = splat(pixels, shown, grid, engine=engine)
        else:
            powers, pairs = pairs[:, :1], pairs[:, 2:]
    else:
        powers = splat(pixels, shown, grid, engine=engine)
        pairs = powers[:, :0]
        if plan.pairs:
            assert imaginary is not None  # channels differ in polarisation
            pairs = splat_parts(pixels, torch.stack([real, imaginary], dim=-1).flatten(2), grid, None, "area", engine)
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
        names, frame = stacks[0].of_channels, _ANY.look.frame
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

    The last is the polarisation of each channel, in order of the second. If there is one, pairs share the power.
    """
    power = amplitudes[..., law.power_channel] * lit_area
    if not isinstance(law, Polarimetric) or not any(plan.names):
        return power, power[..., None], power[..., None], None, (0,) * len(plan.names)
    places = [law.polarisations.index(name) for name in plan.names]
    own = sorted(set(places))
    lit = amplitudes * lit_area[..., None]
    kinds = tuple(own.index(place) for place in places)
    if len(own) == 1:
        alone = lit[..., [1 + own[0]]]
        return power, alone, alone, None, kinds
    matrices = covariances_between(lit, len(law.polarisations))
    pairs = matrices[..., [places[i] for i, _ in plan.pairs], [places[j] for _, j in plan.pairs]]
    return power, lit[..., [1 + place for place in own]], pairs.real, pairs.imag, kinds
