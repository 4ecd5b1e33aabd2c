"""Density control as in 3D Gaussian splatting, with the paper's thresholds: clone, split, prune."""

from dataclasses import replace

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians
from sarsplat.geometry import ImageGrid
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.strategies import ops
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State
from sarsplat.renderer import Rendering


class DensityControl(Configured):
    """Sums plane gradients and, at intervals, prunes, clones and splits Gaussians."""

    order = 10
    name = "density"
    section = "densification"

    def initial_state(self, params: Params) -> State:
        """Sums of gradients over the views that lit a Gaussian, and the number of these views."""
        zeros = params["means"].detach().new_zeros(len(params["means"]))
        return State(rows={"gradient": zeros, "seen": zeros.clone()})

    def wants_plane_gradients(self, step: int) -> bool:
        return bool(step <= self.settings.stop)

    def due(self, step: int) -> bool:
        c = self.settings
        return c.start <= step < c.stop and step % c.every == 0

    def gather(self, state: State, step: int, rendering: Rendering, grid: ImageGrid) -> None:
        if not self.wants_plane_gradients(step):
            return
        assert rendering.plane_gradients is not None
        half = 0.5 * grid.columns * grid.spacing_m[0]  # per half image width: the unit of 3DGS's threshold
        slopes = rendering.plane_gradients
        total = torch.stack([slopes[..., 0] + slopes[..., 2], slopes[..., 1], slopes[..., 3]], dim=-1)
        lit = (rendering.lit_area > 0).float()
        state.rows["gradient"] += (total.norm(dim=-1) * half * lit).sum(0)
        state.rows["seen"] += lit.sum(0)

    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        pruned, cloned, divided = self.decide(info.model.target(0).detach(), info.images.grid, state)
        source = ops.duplicate(params, optimizers, state, cloned)
        pruned, divided = pruned[source], divided[source]
        source = ops.split(params, optimizers, state, divided, info.generator)
        ops.remove(params, optimizers, state, pruned[source])
        state.rows = {name: torch.zeros_like(rows) for name, rows in state.rows.items()}

    def decide(self, gaussians: Gaussians, grid: ImageGrid, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """Masks, bool [N], of the Gaussians to prune, to clone and to split; raise if none would be left.

        Sizes are relative to the grid's resolution cell and its extent in range.
        """
        c = self.settings
        size = gaussians.scales.max(dim=1).values
        plain = replace(gaussians, scattering=gaussians.scattering.detailed(0))  # isotropic part of the law
        scattering = plain.gamma0(gaussians.means.new_tensor([[0.0, 0.0, 1.0]]))[0]
        pruned = (scattering * -torch.expm1(-gaussians.optical_depth) < c.min_scattering) | (
            size > c.max_extent * grid.rows * grid.spacing_m[1]
        )
        if bool(pruned.all()):
            raise SarsplatError(
                f"density control would remove all Gaussians: none scatters at least {c.min_scattering:g} "
                f"(densification.min_scattering) and is smaller than {c.max_extent:g} of the range "
                "(densification.max_extent); lower the first or raise the second"
            )
        slope = state.rows["gradient"] / state.rows["seen"].clamp(min=1)
        grows = (slope > c.gradient) & ~pruned
        room = max(0, c.max_gaussians - len(gaussians))
        if int(grows.sum()) > room:  # the strongest first
            strongest = torch.where(grows, slope, 0.0).argsort(descending=True, stable=True)
            grows = torch.zeros_like(grows).index_fill(0, strongest[:room], True)
        large = size > c.split_above * grid.cell_m
        return pruned, grows & ~large, grows & large
