"""Covariances between passes and polarisations, as the power of an image is rendered: second order."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Complex, Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.law_polarimetric import Polarimetric
from sarsplat.gaussians.scattering import Scattering
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.stack import Stack
from sarsplat.renderer.planes import lit_planes


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
    planes, _, _ = lit_planes(gaussians, views, grid, stacks, rays=rays, shift=shift, engine=engine)
    return planes.whole()


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
