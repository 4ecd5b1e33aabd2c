"""Differentiable renderer: from Gaussians, views and a grid to SAR images and cross-sections."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sarsplat.arguments import checks_arguments
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Ground
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.checks import check_for_reference, check_options, check_shapes, check_values
from sarsplat.renderer.covariances import render_covariances
from sarsplat.renderer.echoes import Echo, GroundEcho
from sarsplat.renderer.echoes.bounce import GroundBounce
from sarsplat.renderer.echoes.echo import all_visible, check_echoes
from sarsplat.renderer.engines.bounds import Bounds
from sarsplat.renderer.engines.choice import ENGINES, chosen_engine, passes_for
from sarsplat.renderer.engines.on_device import ChosenViews, NotRecordable, candidates
from sarsplat.renderer.operations import Steps, render_with
from sarsplat.renderer.reference import render_reference
from sarsplat.renderer.rendering import Attenuation, Footprints, Projection, RayMap, Rendering, Waves, channel_of
from sarsplat.renderer.steps import attenuate, project, splat
from sarsplat.renderer.stretched import render_stretched

__all__ = [
    "Attenuation",
    "Bounds",
    "Footprints",
    "GroundBounce",
    "Projection",
    "RayMap",
    "Rendering",
    "Waves",
    "attenuate",
    "channel_of",
    "project",
    "render",
    "render_covariances",
    "splat",
]


@checks_arguments
def render(
    gaussians: Gaussians,
    views: Sequence[View],
    grid: ImageGrid,
    *,
    rays: RayGrid | None = None,
    amplitudes: Float[Tensor, "v n c"] | None = None,
    shift: Float[Tensor, "v 2"] | None = None,
    gain: Float[Tensor, " v"] | None = None,
    imaging_weight: str = "area",
    ground: Ground | None = None,
    echoes: Sequence[Echo] = (),
    first_return_depth: float | None = None,
    plane_gradients: bool = False,
    bounds: Bounds | None = None,
    engine: str = "auto",
) -> Rendering:
    """Render SAR images of Gaussians in several views.

    On the computation plane rays attenuate through the Gaussians front to back and give each its radar cross-section;
    on the imaging plane (azimuth × slant range) the cross-sections are splatted additively. Differentiable with respect
    to every tensor of `gaussians` and `ground`, and to `amplitudes`, `shift` and `gain`; footprint cuts, depth order
    and the early stop are held constant.

    Parameters
    ----------
    gaussians : Gaussians
        The scene, N Gaussians.
    views : sequence of View
        V views, at least one. Stretched ones have no ground, other echoes or ray maps, and do not use `bounds`.
    grid : ImageGrid
        Pixels and system response, the same for all views.
    rays : RayGrid, optional
        Rays of the computation plane; two to a pixel spacing unless given. An accuracy setting: finer is better.
    amplitudes : Tensor [V, N, C], optional
        Return of each Gaussian per lit area in each view and channel (γ⁰ in a channel of power), dimensionless, in
        place of `gaussians.scattering`. Channels share the work: C images cost little more than one.
    shift : Tensor [V, 2], optional
        Displacement (azimuth, range) of each image, m.
    gain : Tensor [V], optional
        Factor on the power of each image.
    imaging_weight : {"area", "peak"}
        "area" conserves cross-section; "peak" is the paper's unnormalised weight exp(−½eᵀΣ⁻¹e), for ablations only.
    ground : Ground, optional
        Plane or terrain on which rays end: it is in the images, and hides Gaussians whose centres are below it.
    echoes : sequence of Echo
        Further returns that are added to the images: `GroundBounce`, or custom ones (`sarsplat.renderer.echoes`).
    first_return_depth : float, optional
        Two-way optical depth at which a ray counts as returned; asks for `Rendering.ray_maps`.
    plane_gradients : bool
        Ask for `Rendering.plane_gradients` (CPU and CUDA engines).
    bounds : Bounds, optional
        Limits that the Gaussians keep. With them the CUDA engine does not synchronise, and reports values out of range
        and Gaussians beyond them in `bounds.check()`; narrow limits are faster, for its arrays hold the worst case.
        Other engines ignore them, and so do renderings with `GroundBounce`, whose mirror image is beyond them.
    engine : {"auto", "cpu", "cpu-base", "cpu-avx2", "cpu-avx512", "cuda", "reference"}
        "auto" is the CPU engine for float32 on the CPU, the CUDA engine for float32 on a GPU where a small scene with
        gradients agrees with the CPU's, and the reference otherwise; the first time, the logger "sarsplat" says which
        it took. "cpu" uses the widest instruction set of this processor unless one is named.

    Returns
    -------
    Rendering
        Images [V, C, rows, columns] are β⁰, linear power, where a channel is power.

    Raises
    ------
    SarsplatError
        If shapes or dtypes do not fit, a value is out of range, an option is unknown, or the engine is not available.

    Notes
    -----
    Source: SAR-GS, eqs. (4)–(13), as amended in docs/concepts/paper-map.md.

    The CPU engine borrows torch's threads (`torch.set_num_threads`); its results do not depend on their number. As with
    all of torch, a forked process must begin with `torch.set_num_threads(1)`; torch's data loaders do that.

    The CUDA engine is compiled and compared with the CPU engine at first use, which takes a few seconds, and both are
    cached in the user's cache folder. Its results are the same bits in every run. If it disagrees with the CPU engine,
    "auto" raises for tensors on that GPU.
    """
    rays = rays or RayGrid.for_image(grid)
    views = views if isinstance(views, ChosenViews) else tuple(views)
    check_options(imaging_weight=imaging_weight, first_return_depth=first_return_depth)
    check_shapes(gaussians, views, amplitudes, shift, gain)
    channels = len(gaussians.scattering.channels) if amplitudes is None else amplitudes.shape[2]
    echoes = (*(() if ground is None else (GroundEcho(ground),)), *echoes)
    check_echoes(echoes, gaussians, views, channels, imaging_weight)
    gaussians = all_visible(echoes, gaussians)
    engine = chosen_engine(engine, gaussians.means)
    by_view = {"amplitudes": amplitudes, "shift": shift, "gain": gain}
    tensors = {**gaussians.tensors(), **by_view}
    options: dict[str, Any] = {**by_view, "rays": rays, "imaging_weight": imaging_weight}
    stretched = any(view.stretch != 1 for view in candidates(views)[0])
    if stretched and (echoes or first_return_depth is not None):
        raise SarsplatError("a view is stretched, which has no ground, echoes or ray maps; leave these out")
    new_pass = passes_for(engine, tensors, grid)
    if new_pass is None:
        if plane_gradients:
            raise SarsplatError(
                f"plane_gradients=True needs another engine ({', '.join(ENGINES)}); the reference has autograd instead"
            )
        check_for_reference(tensors)
        for echo in echoes:
            check_values(echo.values())
    elif stretched:
        check_values(by_view)  # the engine checks the rest
    if stretched:
        return render_stretched(Steps(new_pass), gaussians, views, grid, **options, plane_gradients=plane_gradients)
    options |= {"echoes": echoes, "first_return_depth": first_return_depth}
    if new_pass is None:
        rendering = render_reference(gaussians, views, grid, **options)
    else:
        within_bounds = all(echo.within_bounds for echo in echoes)
        if not within_bounds and isinstance(views, ChosenViews):
            raise NotRecordable("has an echo from beyond its bounds")
        if bounds is not None and within_bounds and ENGINES[engine].takes_bounds:
            if bounds.broken.device != gaussians.means.device:
                raise SarsplatError(
                    f"bounds are on {bounds.broken.device} but means is on {gaussians.means.device}; make them there"
                )
            capacity = bounds.capacity(len(gaussians), views, grid, rays)
            new_pass = partial(new_pass, capacity=capacity)
            bounds = bounds if capacity else None
        else:
            bounds = None
        options |= {"plane_gradients": plane_gradients, "bounds": bounds}
        rendering = render_with(new_pass, gaussians, views, grid, **options)
    return rendering if ground is None else replace(rendering, ground=rendering.echoes[0])
