"""A run of Gaussians that another program or a loop of one's own has made: the settings and the state that it needs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sarsplat.data.outliers import SIGMAS, outliers
from sarsplat.data.ply import far_from_origin
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.covariance import rotation_matrix
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.target import law
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.learning.snapshot import Snapshot
from sarsplat.renderer import channel_of
from sarsplat.settings.config import OWN_LOOP, Config
from sarsplat.tiles import at_once

_DEGREES = (3, 2, 1, 0)
"""Of the harmonics, largest first."""

_PIXELS = 128
_COARSEST_M = 1e6
_FILLED = 0.7
"""Of an image's width, by the Gaussians that are not faint."""

_CELL_SIGMAS = 2.0  # resolution cell in standard deviations of a Gaussian, as after our own trainings
_FAINT = 0.05
"""Optical depth below which a Gaussian hardly shows."""

_AROUND = tuple(View(azimuth, grazing) for grazing in (15.0, 45.0, 75.0) for azimuth in range(0, 360, 45))


def usual_grid(gaussians: Gaussians) -> ImageGrid:
    """128 × 128 square pixels as wide as their resolution, which show the Gaussians from any direction.

    No pixel is much finer than the Gaussians: points and meshes are as fine as the pixels, and would be huge. What
    lies apart of the scene, or is far larger than it, may lie outside; a warning says how much that is.
    """
    shown = gaussians[gaussians.optical_depth > _FAINT]
    shown = (shown if len(shown) else gaussians).detach()
    if not bool(shown.means.isfinite().all()):
        raise SarsplatError("the centre of a Gaussian is not finite, so no grid can be chosen; give finite ones")
    moved = far_from_origin(shown.means.cpu().numpy(), shown.scales.cpu().numpy())
    if moved.any():
        middle = ", ".join(f"{value:.10g}" for value in moved)
        raise SarsplatError(
            f"the Gaussians lie around ({middle}) m, too far from the origin for an image around it; subtract "
            "that from their means, or give a grid"
        )
    reach = shown.means.norm(dim=1) + SIGMAS * shown.scales.amax(dim=1)  # images are centred on the world's origin
    outside = _strays(shown)
    coarse_m = _CELL_SIGMAS * float(shown.scales.amax(dim=1).median())
    spacing_m = float(f"{max(2 * float(reach[~outside.to(reach.device)].max()) / (_FILLED * _PIXELS), coarse_m):.2g}")
    if spacing_m > _COARSEST_M:
        raise SarsplatError(
            f"the Gaussians reach {float(reach[~outside.to(reach.device)].max()):.3g} m from the origin, farther than "
            "any image shows; check their unit and their scales, or give a grid"
        )
    if outside.any():
        warnings.warn(
            f"{_described(shown, outside)}; images are {_PIXELS * spacing_m:.3g} m wide, for the others: remove those, "
            "or give a grid",
            SarsplatWarning,
            stacklevel=3,
        )
    return ImageGrid(_PIXELS, _PIXELS, (spacing_m, spacing_m), (spacing_m, spacing_m))


def without_strays(gaussians: Gaussians) -> tuple[Gaussians, str]:
    """Gaussians without those that lie apart from the scene or are far larger, and a sentence of these or nothing."""
    outside = _strays(gaussians)
    return (gaussians[~outside], _described(gaussians, outside)) if outside.any() else (gaussians, "")


def _strays(gaussians: Gaussians) -> Tensor:
    parts = (gaussians.means, gaussians.scales, gaussians.quaternions)
    return torch.from_numpy(outliers(*(part.detach().cpu().numpy() for part in parts)))


def _described(gaussians: Gaussians, outside: Tensor) -> str:
    """How many are outside, how far they reach, and what share of the power is theirs."""
    reach = (gaussians.means.norm(dim=1) + SIGMAS * gaussians.scales.amax(dim=1))[outside].max()
    power = torch.stack([_returned(gaussians.detach(), view) for view in _AROUND[::5]]).sum(0).cpu()
    share = float(power[outside].sum() / power.sum().clamp_min(torch.finfo(torch.float64).tiny))
    many = int(outside.sum())
    are = "lies apart or is" if many == 1 else "lie apart or are"
    return (
        f"{many:,} of {len(gaussians):,} Gaussians {are} far larger than all others: up to {float(reach):.3g} m from "
        f"the origin, {100 * share:.2g} % of the power without shadows"
    )


def _returned(gaussians: Gaussians, view: View) -> Tensor:
    """What each Gaussian returns where nothing shadows it, up to a factor [N]."""
    towards = torch.from_numpy(view.direction)
    exact = gaussians.to(torch.float64)
    inside = torch.einsum("nij,i->nj", rotation_matrix(exact.quaternions), towards.to(exact.means.device))
    areas = exact.scales.prod(dim=1, keepdim=True) / exact.scales * inside
    return areas.norm(dim=1) * -torch.expm1(-exact.optical_depth) * exact.gamma0(towards[None])[0]


def own_scene(
    gaussians: Gaussians, grid: ImageGrid | None, views: Sequence[View] | None, brightest: float | None, time_s: float
) -> tuple[Config, Snapshot]:
    """Settings and state of a run; without grid, views or the brightest power, usual ones are chosen.

    Refused if there are no Gaussians or no views, or configurations cannot name the law of scattering and its settings.
    """
    own = gaussians.detach().to("cpu").to(torch.float32)
    views = _AROUND if views is None else tuple(views)
    if not views or not len(own):
        raise SarsplatError(f"a run needs at least one {'view' if len(own) else 'Gaussian'}; give some")
    grid = grid or usual_grid(own)
    scattering, settings = own.scattering, own.scattering.settings()
    usual = Config(
        preset=OWN_LOOP,
        iterations=_DEGREES[0],
        gaussians=len(own),
        scattering=scattering.kind,
        p_min=scattering.p_min,
        common_law=False,
        harmonics_every=1,
    )
    configs = [replace(usual, harmonics_degree=degree) for degree in _DEGREES]
    laws = [law(config, 1, 1.0) for config in configs]
    columns = scattering.parameters.shape[1]
    fits = [each.parameters.shape[1] == columns and each.settings() == settings for each in laws]
    if type(scattering) is not type(laws[0]) or not any(fits):
        raise SarsplatError(
            f"a run cannot keep the scattering law {shown(scattering.kind)} with {columns} columns of parameters and "
            f"the settings {shown(settings)}; use what its `initial` gives"
        )
    config = configs[fits.index(True)]
    tensors: dict[str, Tensor] = {name: tensor.contiguous() for name, tensor in own.tensors().items()}
    region = Region.box(own.means.amin(0).tolist(), own.means.amax(0).tolist())
    frame = SceneFrame(region, 1.0, views, grid)
    model = SceneModel(config, frame, tensors)
    if brightest is None:
        rays = RayGrid.for_image(grid)
        few = views if at_once(own, views[:1], grid, rays) else views[:1]  # of a scene that is rendered by tiles
        images = (image for view in few for image in model.unseen([view], grid, _DEGREES[0], rays))
        brightest = max(float(channel_of(image, model.power_channel).max()) for image in images)
    brightest = max(brightest, torch.finfo(torch.float32).tiny)
    return config, Snapshot(config.iterations, time_s, (), grid, views, 1.0, brightest, model.tensors())
