"""Steps of a rendering, each differentiable: project, attenuate, splat."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Inexact
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.gaussians import check_same_kind
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.geometry.view import check_unstretched
from sarsplat.renderer.checks import check_channels, check_for_reference, check_options, check_shapes
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.operations import Steps
from sarsplat.renderer.rendering import Attenuation, Footprints, Projection, Waves


@checks_arguments
def project(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    engine: str = "auto",
) -> Projection:
    """Project Gaussians to footprints on the computation and imaging planes of several views, with amplitudes.

    First of three steps that together do what `render` does, with access to intermediate values; `render` is faster::

        projection = project(gaussians, views, grid)
        lit_area = attenuate(projection, RayGrid.for_image(grid)).lit_area
        cross_sections = projection.amplitudes * lit_area[..., None]  # [V, N, C], m²
        images = splat(projection.pixels, cross_sections, grid)  # [V, C, rows, columns]

    Differentiable with respect to `means`, `quaternions`, `scales`, `optical_depth`, the
    parameters of `scattering`, and `shift`.

    Parameters
    ----------
    gaussians, views, rays, shift, engine
        As at `render`; the cell of a ray widens the footprints on the computation plane.
    grid : ImageGrid
        Its response widens the footprints on the imaging plane.

    Returns
    -------
    Projection
        Footprints in metres.

    Raises
    ------
    SarsplatError
        If shapes or dtypes do not fit, a value is out of range, an option is unknown, or the engine is not available.
    """
    rays = rays or RayGrid.for_image(grid)
    views = tuple(views)
    check_shapes(gaussians, views, None, shift, None)
    check_unstretched(views)
    tensors = {**gaussians.tensors(), "shift": shift}
    if (new_pass := passes_for(engine, tensors, grid)) is None:
        check_for_reference(tensors)
    return Steps(new_pass).project(gaussians, views, grid, rays=rays, shift=shift)


@checks_arguments
def attenuate(
    projection: Projection, rays: RayGrid, *, first_return_depth: float | None = None, engine: str = "auto"
) -> Attenuation:
    """Send rays through the footprints of the computation plane, front to back; return the lit areas.

    Differentiable with respect to the centres, the roots and the optical depths; footprint cuts, depth order and the
    early stop are held constant.

    Parameters
    ----------
    projection : Projection
        Result of `project`; its `pixels` are not used.
    rays : RayGrid
        Ray lattice; the same as for `project`, which widened the footprints by its cell.
    first_return_depth, engine
        As at `render`; the depth asks for `Attenuation.ray_maps`.

    Returns
    -------
    Attenuation
        Lit areas, m².

    Raises
    ------
    SarsplatError
        If a value is out of range, an option is unknown, or the engine is not available.
    """
    check_options(first_return_depth=first_return_depth)
    p = projection
    tensors: dict[str, Tensor | None] = {
        "rays.centers": p.rays.centers,
        "rays.roots": p.rays.roots,
        "optical_depth": p.optical_depth,
        "range_m": p.range_m,
        "tilt": p.tilt,
    }
    _check_batch("rays.centers", p.rays.centers)
    if (new_pass := passes_for(engine, tensors)) is None:
        check_for_reference(tensors, by_view=True)
    return Steps(new_pass).attenuate(p, rays, first_return_depth=first_return_depth)


@checks_arguments
def splat(
    footprints: Footprints,
    cross_sections: Inexact[Tensor, "v n c"],
    grid: ImageGrid,
    *,
    waves: Waves | None = None,
    imaging_weight: str = "area",
    engine: str = "auto",
) -> Inexact[Tensor, "v c {grid.rows} {grid.columns}"]:
    """Add footprints to images, each with a cross-section for every channel: linear in them, in any order.

    Differentiable with respect to the centres, the roots, the cross-sections and the slopes of the waves; footprint
    cuts are held constant. Channels share the work on a footprint: polarisations, looks or features cost little more
    than one image.

    Parameters
    ----------
    footprints : Footprints
        On the imaging plane: `Projection.pixels`, N Gaussians in V views.
    cross_sections : Tensor [V, N, C]
        Cross-sections of Gaussians in each view and channel, m² for an image of β⁰, of any sign; or complex amplitudes,
        for complex images.
    grid : ImageGrid
        Pixels; the same as for `project`, which widened the footprints by its response.
    waves : Waves, optional
        Phase gradients of complex cross-sections across the footprints.
    imaging_weight, engine
        As at `render`.

    Returns
    -------
    Tensor [V, C, rows, columns]
        The images, complex if the cross-sections are.

    Raises
    ------
    SarsplatError
        If shapes or dtypes do not fit, a value is out of range, an option is unknown, or the engine is not available.
    """
    check_options(imaging_weight=imaging_weight)
    v, n, _ = footprints.centers.shape
    check_channels("cross_sections", cross_sections, v, n)
    name = "cross_sections.real" if cross_sections.is_complex() else "cross_sections"
    check_same_kind({"footprints.centers": footprints.centers, name: cross_sections.real})
    if waves is not None:
        _check_waves(waves, cross_sections)
    if cross_sections.is_complex():
        parts = torch.view_as_real(cross_sections.resolve_conj()).flatten(2)
        images = splat_parts(footprints, parts, grid, waves, imaging_weight, engine)
        return torch.view_as_complex(images.unflatten(1, (-1, 2)).movedim(2, -1).contiguous())
    return splat_parts(footprints, cross_sections, grid, waves, imaging_weight, engine)


def splat_parts(
    footprints: Footprints,
    cross_sections: Float[Tensor, "v n c"],
    grid: ImageGrid,
    waves: Waves | None,
    imaging_weight: str,
    engine: str,
) -> Float[Tensor, "v c {grid.rows} {grid.columns}"]:
    """Splat real channels; with waves, alternating real and imaginary parts."""
    tensors: dict[str, Tensor | None] = {
        "footprints.centers": footprints.centers,
        "footprints.roots": footprints.roots,
        "cross_sections": cross_sections,
        "waves.slopes": None if waves is None else waves.slopes,
    }
    _check_batch("footprints.centers", footprints.centers)
    if (new_pass := passes_for(engine, tensors, grid)) is None:
        check_for_reference(tensors, by_view=True)
    return Steps(new_pass).splat(footprints, cross_sections, grid, waves=waves, imaging_weight=imaging_weight)


def _check_waves(waves: Waves, cross_sections: Tensor) -> None:
    v, n, c = cross_sections.shape
    if not cross_sections.is_complex():
        raise SarsplatError(
            f"cross_sections is {cross_sections.dtype}, which has no phase; give complex ones, or no waves"
        )
    found, expected = (tuple(waves.slopes.shape), tuple(waves.numbers.shape)), ((v, n, 2), (v, c))
    if found != expected:
        raise SarsplatError(
            f"waves has slopes {found[0]} and numbers {found[1]}; for cross_sections {(v, n, c)} they must be "
            f"{expected[0]} and {expected[1]}"
        )
    check_same_kind({"cross_sections.real": cross_sections.real, "waves.slopes": waves.slopes})


def _check_batch(name: str, tensor: Tensor) -> None:
    if tensor.shape[0] < 1:
        raise SarsplatError(f"{name} has shape {tuple(tensor.shape)}, which has no views; give at least one")
