"""Settings and state of a run of Gaussians from a custom training loop or a file."""

import warnings
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sarsplat.data.outliers import SIGMAS, outliers
from sarsplat.data.ply import far_from_origin
from sarsplat.errors import SarsplatError, SarsplatWarning, shown
from sarsplat.gaussians import Gaussians
from sarsplat.gaussians.gaussians import rotation_matrix
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.learning.model import SceneModel
from sarsplat.learning.parts.target import law
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.learning.snapshot import Snapshot
from sarsplat.settings.config import OWN_LOOP, Config
from sarsplat.tiles import at_once

_DEGREES = (3, 2, 1, 0)  # degrees of harmonics, largest first

_PIXELS = 128
_MAX_SPACING_M = 1e6
_FILLED_SHARE = 0.7  # extent of the visible Gaussians relative to the width of an image
_CELL_SIGMAS = 2.0  # resolution cell in standard deviations of a Gaussian, as after our own trainings
_FAINT = 0.05  # optical depth below which a Gaussian is ignored in the choice of a grid

_AROUND = tuple(View(azimuth, grazing) for grazing in (15.0, 45.0, 75.0) for azimuth in range(0, 360, 45))


def usual_grid(gaussians: Gaussians) -> ImageGrid:
    """Choose 128 × 128 square pixels as wide as their resolution that show the Gaussians from any direction.

    Pixels are not much finer than the Gaussians: points and meshes, as fine as the pixels, would be huge. Outliers may
    lie outside, with a warning.
    """
    shown = gaussians[gaussians.optical_depth > _FAINT]
    shown = (shown if len(shown) else gaussians).detach()
    if not bool(shown.means.isfinite().all()):
        raise SarsplatError("the centre of a Gaussian is not finite, so no grid can be chosen; give finite ones")
    moved = far_from_origin(shown.means.cpu().numpy(), shown.scales.cpu().numpy())
    if moved.any():
        centre = ", ".join(f"{value:.10g}" for value in moved)
        raise SarsplatError(
            f"the Gaussians lie around ({centre}) m, too far from the origin for an image around it; subtract "
            "that from their means, or give a grid"
        )
    reach = shown.means.norm(dim=1) + SIGMAS * shown.scales.amax(dim=1)  # images are centred on the world's origin
    outside = _strays(shown)
    farthest_m = float(reach[~outside.to(reach.device)].max())
    coarse_m = _CELL_SIGMAS * float(shown.scales.amax(dim=1).median())
    spacing_m = float(f"{max(2 * farthest_m / (_FILLED_SHARE * _PIXELS), coarse_m):.2g}")
    if spacing_m > _MAX_SPACING_M:
        raise SarsplatError(
            f"the Gaussians reach {farthest_m:.3g} m from the origin, farther than any image shows; check their unit "
            "and their scales, or give a grid"
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
    """Return the Gaussians without outliers in place or size, and a sentence about these, or an empty one."""
    outside = _strays(gaussians)
    return (gaussians[~outside], _described(gaussians, outside)) if outside.any() else (gaussians, "")


def _strays(gaussians: Gaussians) -> Tensor:
    parts = (gaussians.means, gaussians.scales, gaussians.quaternions)
    return torch.from_numpy(outliers(*(part.detach().cpu().numpy() for part in parts)))


def _described(gaussians: Gaussians, outside: Tensor) -> str:
    """Describe outliers: number, extent and share of the power."""
    reach = (gaussians.means.norm(dim=1) + SIGMAS * gaussians.scales.amax(dim=1))[outside].max()
    power = torch.stack([_returned(gaussians.detach(), view) for view in _AROUND[::5]]).sum(0).cpu()
    share = float(power[outside].sum() / power.sum().clamp_min(torch.finfo(torch.float64).tiny))
    count = int(outside.sum())
    are = "lies apart or is" if count == 1 else "lie apart or are"
    return (
        f"{count:,} of {len(gaussians):,} Gaussians {are} far larger than all others: up to {float(reach):.3g} m from "
        f"the origin, {100 * share:.2g} % of the power without shadows"
    )


def _returned(gaussians: Gaussians, view: View) -> Tensor:
    """Return the radar cross-section of each Gaussian without occlusion, up to a factor [N]."""
    towards = torch.from_numpy(view.direction)
    exact = gaussians.to(torch.float64)
    inside = torch.einsum("nij,i->nj", rotation_matrix(exact.quaternions), towards.to(exact.means.device))
    areas = exact.scales.prod(dim=1, keepdim=True) / exact.scales * inside
    return areas.norm(dim=1) * -torch.expm1(-exact.optical_depth) * exact.gamma0(towards[None])[0]


def own_scene(
    gaussians: Gaussians, grid: ImageGrid | None, views: Sequence[View] | None, brightest: float | None, time_s: float
) -> tuple[Config, Snapshot]:
    """Return settings and state of a run; by default, with grid, views and brightest power chosen here.

    Raise without Gaussians or views, or if settings cannot represent the law of scattering.
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
    laws = [law(config, count=1, gamma0=1.0) for config in configs]
    columns = scattering.parameters.shape[1]
    matches = [candidate.parameters.shape[1] == columns and candidate.settings() == settings for candidate in laws]
    if type(scattering) is not type(laws[0]) or not any(matches):
        raise SarsplatError(
            f"a run cannot keep the scattering law {shown(scattering.kind)} with {columns} columns of parameters and "
            f"the settings {shown(settings)}; use what its `initial` gives"
        )
    config = configs[matches.index(True)]
    tensors: dict[str, Tensor] = {name: tensor.contiguous() for name, tensor in own.tensors().items()}
    region = Region.box(own.means.amin(0).tolist(), own.means.amax(0).tolist())
    frame = SceneFrame(region, 1.0, views, grid)
    model = SceneModel(config, frame, tensors)
    if brightest is None:
        rays = RayGrid.for_image(grid)
        bright_views = views if at_once(own, views[:1], grid, rays) else views[:1]  # of a scene rendered by tiles
        brightest = max(float(model.unseen([view], grid, _DEGREES[0], rays).max()) for view in bright_views)
    brightest = max(brightest, torch.finfo(torch.float32).tiny)
    return config, Snapshot(config.iterations, time_s, (), grid, views, 1.0, brightest, model.tensors())
