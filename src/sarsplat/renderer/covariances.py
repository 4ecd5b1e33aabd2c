"""Expected covariances between the channels of stacks, rendered as a few real images.

The images are one of power for each polarisation, and a complex one, real and imaginary parts in turn, for each
distinct pair of channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, Gaussians, Scattering
from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.gaussians.law_polarimetric import Polarimetric, covariances_between
from sarsplat.geometry import ImageGrid, RayGrid, Stack, View
from sarsplat.renderer.constants import MIN_RAY_DEPTH
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.operation import Operation
from sarsplat.renderer.rendering import Footprints, Waves
from sarsplat.renderer.steps import attenuate, project, splat, splat_parts

_PAIR_TOLERANCE = 1e-5
"""Maximum difference, relative to the largest phase per elevation, between pairs of passes that share an image."""

_ANY = View(0.0, 45.0)  # view for phases in the radar frame, which are equal in all views


@checks_arguments
def render_covariances(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    stack: Stack | Sequence[Stack],
    *,
    rays: RayGrid | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    engine: str = "auto",
) -> Complex[Tensor, "v p p {grid.rows} {grid.columns}"]:
    """Render expected covariances E[y_i y_j*] of the channels of a stack, in every pixel of several views.

    The signals of different scatterers are uncorrelated, so covariances add up as powers do: each Gaussian gives its
    cross-section times exp(j(φ_i − φ_j)) and the decorrelation by its extent in elevation. A pixel shows a part of a
    Gaussian, whose mean elevation and phase change across the footprint (`Waves`). Between polarisations, the
    cross-section is an element of the Gaussian's matrix (`Polarimetric`).

    Differentiable as `render` is.

    Parameters
    ----------
    gaussians, views, grid, rays, shift, engine
        As at `render`.
    stack : Stack or sequence of Stack
        P channels, passes or polarisations or both; one stack for all views, or one for each.

    Returns
    -------
    Tensor [V, P, P, rows, columns], complex
        Hermitian and without noise; the diagonal is β⁰. Phases are those of `Stack.phase_vectors`: not deramped
        (`Stack.plane_phases`).

    Raises
    ------
    SarsplatError
        As `render`; or if there are more or fewer stacks than views, of different numbers of passes or different
        polarisations, or of polarisations that the scattering does not know.

    Notes
    -----
    Rays skip Gaussians where these are thinner than an optical depth of 10⁻³, a share 10⁻³/κ of a faint one, which
    would bias the mean phase of a volume. Here the share is compensated, so that powers exceed those of `render` by it.
    """
    stacks = stacks_of(gaussians.scattering, views, stack)
    planes, _, _ = lit_planes(gaussians, views, grid, stacks, rays=rays, shift=shift, engine=engine)
    return planes.whole()


def stacks_of(law: Scattering, views: Sequence[View], stack: Stack | Sequence[Stack]) -> list[Stack]:
    """Return the stack of each view; raise if their covariances cannot be rendered together."""
    stacks = [stack] * len(views) if isinstance(stack, Stack) else [*stack]
    if len(stacks) != len(views) or len({len(one) for one in stacks}) != 1:
        raise SarsplatError(
            f"there are {counted(len(stacks), 'stack')} of {shown([len(one) for one in stacks])} passes for "
            f"{counted(len(views), 'view')}; give one for each, all of the same number of passes"
        )
    known = law.polarisations if isinstance(law, Polarimetric) else None
    for one in stacks:
        asked = list(dict.fromkeys(one.of_channels))
        if len(asked) > 1 if known is None else one.polarisations and not set(asked) <= set(known):
            raise SarsplatError(
                f"a stack has the polarisations {', '.join(asked)}, and the Gaussians' scattering has "
                f"{', '.join(known) if known else 'one alone'}; give stacks of those, or Gaussians with the scattering "
                "Polarimetric"
            )
        if one.of_channels != stacks[0].of_channels:
            raise SarsplatError(
                f"stacks have the polarisations {', '.join(stacks[0].of_channels)} and {', '.join(one.of_channels)}; "
                "give stacks of the same ones"
            )
    return stacks


@dataclass(frozen=True)
class Planes:
    """Expected covariances of the channels of stacks, without noise, as images that channels share.

    `powers` [V, K, rows, columns] are diagonal elements: β⁰ of each polarisation. `pairs` [V, 2 D, rows, columns] are
    off-diagonal elements of channels i < j: real and imaginary parts in turn. `of_channels` and `of_pairs` are indices
    into the K powers by channel, and into the D pairs by pair of channels, in order of rows. `turns` [V, P, rows] are
    phases of the channels that depend on range alone, rad.
    """

    powers: Float[Tensor, "v k rows columns"]
    pairs: Float[Tensor, "v d rows columns"]
    of_channels: tuple[int, ...]
    of_pairs: tuple[int, ...]
    turns: Float[Tensor, "v p rows"]

    def whole(self, phases: Float[Tensor, "v p rows columns"] | None = None) -> Complex[Tensor, "v p p rows columns"]:
        """Return Hermitian matrices, with additional `phases` of the channels."""
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
    """Render covariances; also return the radar cross-section of power and the lit area of each Gaussian, m²."""
    rays = rays or RayGrid.for_image(grid)
    projection = project(gaussians, views, grid, rays=rays, shift=shift, engine=engine)
    depth = projection.optical_depth
    compensated = (depth + MIN_RAY_DEPTH * (depth > 0)).clamp(max=MAX_OPTICAL_DEPTH)
    lit_area = attenuate(replace(projection, optical_depth=compensated), rays, engine=engine).lit_area
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
    """Distinct pairs of the channels of stacks."""

    names: tuple[str, ...]
    """Polarisation of each channel."""
    pairs: tuple[tuple[int, int], ...]
    """Channels (i, j) of the rendered pairs."""
    of_pairs: tuple[int, ...]
    """Index of the rendered pair for each pair i < j."""
    numbers: Float64[np.ndarray, "v d"]
    """Difference of phase per elevation of each rendered pair, rad/m."""
    ranges: Float64[np.ndarray, "v p"]
    """Phase per range of each channel, rad/m."""

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, stacks: tuple[Stack, ...]) -> "_Plan":
        names, frame = stacks[0].of_channels, _ANY.look.frame
        vectors = np.stack([stack.phase_vectors(_ANY) @ frame.T for stack in stacks])
        elevation = vectors[..., 1]
        tolerance = _PAIR_TOLERANCE * np.ptp(elevation)
        pairs: list[tuple[int, int]] = []
        of_pairs = []
        for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
            number = elevation[:, i] - elevation[:, j]
            for place, (a, b) in enumerate(pairs):
                same_names = (names[a], names[b]) == (names[i], names[j])
                if same_names and np.abs(elevation[:, a] - elevation[:, b] - number).max() <= tolerance:
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
    """Return cross-sections, m², of power, of each polarisation, and of each pair, real and imaginary, without phases.

    The last is each channel's index into the polarisations. If there is only one, pairs share its power.
    """
    power = amplitudes[..., law.power_channel] * lit_area
    if not isinstance(law, Polarimetric) or not any(plan.names):
        return power, power[..., None], power[..., None], None, (0,) * len(plan.names)
    places = [law.polarisations.index(name) for name in plan.names]
    own = sorted(set(places))
    lit = amplitudes * lit_area[..., None]
    kinds = tuple(own.index(place) for place in places)
    if len(own) == 1:
        alone = lit[..., [1 + own[0]]]  # the law's first channel is power
        return power, alone, alone, None, kinds
    matrices = covariances_between(lit, len(law.polarisations))
    pairs = matrices[..., [places[i] for i, _ in plan.pairs], [places[j] for _, j in plan.pairs]]
    return power, lit[..., [1 + place for place in own]], pairs.real, pairs.imag, kinds


def elevated(
    gaussians: Gaussians,
    views: Sequence[View],
    pixels: Footprints,
    numbers: Float64[np.ndarray, "v d"],
    real: Float[Tensor, "v n d"] | Float[Tensor, "v n 1"],
    imaginary: Float[Tensor, "v n d"] | None,
    engine: str,
) -> tuple[Float[Tensor, "v n k"], Float[Tensor, "v n 2"]]:
    """Return cross-sections with phases at the centres of footprints, and the elevation per displacement.

    Given the pixel at the displacement d from the centre of a footprint, scatterers are distributed around μ + K d with
    the covariance Σ − K J Σ, where K = Σ Jᵀ (J Σ Jᵀ + response)⁻¹ and J projects on the imaging plane; only their
    elevation matters. The inverse is that of the footprint. Inputs are cross-sections without phases, of which the real
    part may be one for all pairs, and the phase per elevation of each pair, rad/m; results are real and imaginary parts
    in turn, m², and m per m.
    """
    means, roots = gaussians.means, pixels.roots
    frames = torch.from_numpy(np.stack([view.look.frame for view in views])).to(means)  # [V, 3, 3]
    kappa = torch.from_numpy(numbers).to(means)
    assert real.shape[2] in (1, kappa.shape[1])
    inputs = (means, gaussians.quaternions, gaussians.scales, frames, roots, kappa, real, imaginary)
    named = dict(zip(Sections.names, inputs, strict=True))
    return Sections().on(passes_for(engine, named), *inputs)


class Sections(Operation):
    """Operation of `elevated`, given the radar frames of the views."""

    operation = "pair_sections"
    names = ("means", "quaternions", "scales", "frames", "roots", "numbers", "real", "imaginary")

    def plain(
        self,
        means: Float[Tensor, "n 3"],
        quaternions: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        frames: Float[Tensor, "v 3 3"],
        roots: Float[Tensor, "v n 3"],
        numbers: Float[Tensor, "v d"],
        real: Float[Tensor, "v n d"] | Float[Tensor, "v n 1"],
        imaginary: Float[Tensor, "v n d"] | None,
    ) -> tuple[Float[Tensor, "v n k"], Float[Tensor, "v n 2"]]:
        sides = frames[:, None] @ (rotation_matrix(quaternions) * scales[:, None])  # Σ is their square
        yx, yy, yz = (sides[:, :, 1:2] * sides).sum(-1).unbind(-1)
        a, b, c = roots.unbind(-1)
        mixed = a * b
        slopes = torch.stack([a * a * yx + mixed * yz, mixed * yx + (b * b + c * c) * yz], dim=-1)
        variance = (yy - slopes[..., 0] * yx - slopes[..., 1] * yz).clamp(min=0)
        phase = (frames[:, 1] @ means.T)[..., None] * numbers[:, None]
        coherence = torch.exp(variance[..., None] * (-0.5 * numbers[:, None] ** 2))
        cosine, sine = coherence * phase.cos(), coherence * phase.sin()
        if imaginary is None:
            turned = real * cosine, real * sine
        else:
            turned = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        return torch.stack(turned, dim=-1).flatten(2), slopes

    def numbers(self, *inputs: Tensor) -> dict[str, Any]:
        pairs, (views, gaussians, parts) = inputs[5].shape[1], inputs[6].shape
        return {"views": views, "pairs": pairs, "gaussians": gaussians, "shared": int(parts == 1)}

    def outputs(self, *inputs: Tensor) -> dict[str, Tensor]:
        real, pairs = inputs[6], inputs[5].shape[1]
        parts = real.new_empty(*real.shape[:2], 2 * pairs)
        return {"parts": parts, "slopes": real.new_empty(*real.shape[:2], 2)}
