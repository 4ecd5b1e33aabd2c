"""Covariances between passes and polarisations, as the power of an image is rendered: second order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import covariance
from sarsplat.gaussians.law_polarimetric import Polarimetric, covariances_between
from sarsplat.gaussians.scattering import Scattering
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.geometry.stack import Stack
from sarsplat.renderer.checks import MAX_OPTICAL_DEPTH
from sarsplat.renderer.constants import MIN_RAY_DEPTH
from sarsplat.renderer.footprints import Waves
from sarsplat.renderer.steps import attenuate, project, splat


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
    """Expected covariances E[y_i y_j*] of the channels of a stack, in every pixel of several views.

    The signals of different scatterers are uncorrelated, so covariances add up as powers do: each Gaussian gives its
    cross-section times exp(j(φ_i − φ_j)), times what is left of it as phases differ within the Gaussian. A pixel shows
    only a part of a Gaussian, whose mean elevation changes across the footprint, and the phase with it (`Waves`).
    Between polarisations, the cross-section is that of the Gaussian's own matrix (`Polarimetric`).

    Differentiable as `render` is.

    Parameters
    ----------
    gaussians : Gaussians
        The scene, N Gaussians.
    views : sequence of View
        V views, at least one.
    grid : ImageGrid
        Pixels.
    stack : Stack or sequence of Stack
        P channels, passes or polarisations or both, around every view or around each its own.
    rays : RayGrid, optional
        As at `render`.
    shift : Tensor [V, 2], optional
        Displacement (azimuth, range) of each image, m.
    engine : {"auto", "cpu", "cuda", "reference"}
        As at `render`.

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
    Rays pass faint Gaussians where these are thinner than an optical depth of 10⁻³, which would take a share 10⁻³/κ
    of them away, and of the mean phase of a volume what that share has; here it is made up for, so that powers are by
    that share above those of `render`.
    """
    stacks = stacks_of(gaussians.scattering, views, stack)
    covariances, _, _ = lit_covariances(gaussians, views, grid, stacks, rays=rays, shift=shift, engine=engine)
    return covariances


def stacks_of(law: Scattering, views: Sequence[View], stack: Stack | Sequence[Stack]) -> list[Stack]:
    """The stack of each view; refused if their covariances cannot be rendered together (`render_covariances`)."""
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


def lit_covariances(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    stacks: Sequence[Stack],
    *,
    rays: RayGrid | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    engine: str = "auto",
) -> tuple[Complex[Tensor, "v p p rows columns"], Float[Tensor, "v n"], Float[Tensor, "v n"]]:
    """`render_covariances`, and of each Gaussian the radar cross-section of power and the lit area, m²."""
    rays, passes = rays or RayGrid.for_image(grid), len(stacks[0])
    projection = project(gaussians, views, grid, rays=rays, shift=shift, engine=engine)
    depth = projection.optical_depth
    whole = (depth + MIN_RAY_DEPTH * (depth > 0)).clamp(max=MAX_OPTICAL_DEPTH)
    lit_area = attenuate(replace(projection, optical_depth=whole), rays, engine=engine).lit_area
    first, second = np.triu_indices(passes, 1)
    power, shown, of_pairs, kinds = _sections(gaussians.scattering, projection.amplitudes, lit_area, stacks[0])
    diagonal = splat(projection.pixels, shown, grid, engine=engine)[:, kinds]
    result = diagonal.new_zeros(
        (passes, passes, len(views), grid.rows, grid.columns), dtype=diagonal.dtype.to_complex()
    )
    result[range(passes), range(passes)] = diagonal.transpose(0, 1).to(result)
    if len(first):
        vectors = np.stack([stack.phase_vectors(view) for stack, view in zip(stacks, views, strict=True)])
        waves = None
        if vectors.any():
            phase, left, waves = _pairs(gaussians, views, grid, vectors[:, first] - vectors[:, second])
            of_pairs = of_pairs * torch.polar(left, phase)
        pairs = splat(projection.pixels, of_pairs, grid, waves=waves, engine=engine)
        result[first, second] = pairs.transpose(0, 1)
        result[second, first] = pairs.transpose(0, 1).conj()
    return result.movedim(2, 0), power, lit_area


def _sections(
    law: Scattering, amplitudes: Float[Tensor, "v n c"], lit_area: Float[Tensor, "v n"], stack: Stack
) -> tuple[Float[Tensor, "v n"], Float[Tensor, "v n k"], Tensor, list[int]]:
    """Cross-sections, m²: of power, of each polarisation, and of each pair of channels, all at one place.

    The last is the polarisation of each channel, in order of the second.
    """
    names = stack.of_channels
    power = amplitudes[..., law.power_channel] * lit_area
    if not isinstance(law, Polarimetric) or not stack.polarisations:
        return power, power[..., None], power[..., None], [0] * len(names)
    places = [law.polarisations.index(name) for name in names]
    own = sorted(set(places))
    lit = amplitudes * lit_area[..., None]
    first, second = np.triu_indices(len(names), 1)
    matrices = covariances_between(lit, len(law.polarisations))
    pairs = matrices[..., [places[i] for i in first], [places[j] for j in second]]
    return power, lit[..., [1 + place for place in own]], pairs, [own.index(place) for place in places]


def _pairs(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, vectors: np.ndarray
) -> tuple[Float[Tensor, "v n q"], Float[Tensor, "v n q"], Waves]:
    """Of Q pairs of passes: phases at the centres of footprints, what is left of coherence, and how phases turn.

    `vectors` [V, Q, 3]: by how much more phase the first of each pair has, rad/m. Given the pixel at the displacement
    d from the centre of a footprint, scatterers are distributed around μ + K d with the covariance Σ − K J Σ, where
    K = Σ Jᵀ (J Σ Jᵀ + response)⁻¹ and J projects on the imaging plane.
    """
    means = gaussians.means
    frames = torch.from_numpy(np.stack([radar_frame(view) for view in views])).to(means)[:, None]  # [V, 1, 3, 3]
    differences = torch.from_numpy(vectors).to(means)
    turned = (frames @ differences[..., None])[..., 0]  # in the radar frame, [V, Q, 3]
    cov = frames @ covariance(gaussians.quaternions, gaussians.scales) @ frames.mT  # [V, N, 3, 3]
    onto = cov[..., ::2]  # Σ Jᵀ, [V, N, 3, 2]
    imaged = onto[..., ::2, :] + torch.diag(means.new_tensor(grid.response_variance_m2))
    gain = torch.linalg.solve(imaged, onto, left=False)  # K
    rest = cov - gain @ onto.mT
    variance = torch.einsum("vqi,vnij,vqj->vnq", turned, rest, turned)
    phase = torch.einsum("vqi,ni->vnq", differences, means)
    return phase, torch.exp(-variance.clamp(min=0) / 2), Waves(turned[..., 1].contiguous(), gain[..., 1, :])
