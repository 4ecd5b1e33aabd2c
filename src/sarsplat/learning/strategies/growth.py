"""Growth and relocation: Gaussians are split where images differ, hidden ones removed, and idle ones join others.

If power decided, roofs would take the Gaussians of dimmer walls that share their pixels, until the walls are glass.
"""

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.parts.part import exact_scale
from sarsplat.learning.strategies import ops
from sarsplat.learning.strategies.ops import running_sums
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State, at_round
from sarsplat.settings.config import Config

_SHARE = 0.9  # share of the images' error held by the Gaussians that are split; the others stay
_CLEARED = 0.5625  # time of the removal, as a share of the iterations; coarse levels go on, so that surfaces recover
_HIDDEN = 0.1  # lit area / (2π s₁ s₂ (1 − e^−κ)), about that of a Gaussian alone, below which it counts as hidden


class Growing(Configured):
    """Splits the Gaussians with most of the error, at the start of each finer level and halfway to the next.

    Each split happens once, also if the training is extended and passes its levels again. At 9/16 of the iterations
    hidden ones are removed, and at most as many others split: fog shines through surfaces, which then bulge.
    """

    order = 15
    name = "growth"

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.coarsest > 1

    def initial_state(self, params: Params) -> State:
        """Number of splits so far."""
        return State(whole={"times": torch.zeros((), dtype=torch.int64, device="cpu")}, added=("times",))

    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        levels = info.model.levels
        before = levels.growths(step - 1)
        if before < levels.growths(step) and before >= int(state.whole["times"]):
            state.whole["times"] = state.whole["times"].new_tensor(before + 1)
            info.check()
            ops.split(params, optimizers, state, holding(info.errors(), _SHARE), info.generator)
        fog_stays = levels.coarsest > 1 and self.config.relocation.alike_from < 1  # its cubes attract like others
        if fog_stays and step == round(_CLEARED * levels.iterations):
            info.check()
            alone = 2 * torch.pi * params["scales"].topk(2).values.prod(1) * -torch.expm1(-params["optical_depth"])
            gone = info.lit_areas() < _HIDDEN * alone
            worst = info.errors().masked_fill(gone, 0.0).argsort(descending=True, stable=True)[: int(gone.sum())]
            again = torch.zeros_like(gone).index_fill(0, worst, True) & ~gone
            ops.remove(params, optimizers, state, gone[ops.split(params, optimizers, state, again, info.generator)])


def holding(errors: Float[Tensor, " n"], share: float) -> Bool[Tensor, " n"]:
    """Mask of the fewest items whose errors sum to at least this share of the total."""
    largest, order = errors.double().sort(descending=True, stable=True)
    held = running_sums(largest)
    return torch.zeros_like(order, dtype=torch.bool).index_copy(0, order, held - largest < share * held[-1])


class Relocating(Configured):
    """Moves idle Gaussians to others, at intervals."""

    order = 20
    name = "relocation"
    section = "relocation"

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.relocation.rounds > 0

    def due(self, step: int) -> bool:
        return step > 0 and at_round(step, 0, self.settings.until * self.config.iterations, self.settings.rounds)

    @torch.no_grad()
    def act(self, params: Params, optimizers: Optimiser, state: State, info: Info) -> None:
        c, shares = self.settings, info.lit_areas().double()
        if info.model.levels.coarsest > 1:  # vehicles have no large surfaces that outshine others
            shares = shares_of_cubes(shares, params["means"], info.images.grid.cell_m, c.alike_from)
        idle, joined = pairs(shares, c.idle_share, info.generator)
        ops.relocate(params, optimizers, state, idle, joined, info.generator)


def shares_of_cubes(
    lit: Float64[Tensor, " n"], means: Float[Tensor, "n 3"], side_m: float, alike_from: float
) -> Float64[Tensor, " n"]:
    """Share of each Gaussian in the lit area of its cube.

    In cubes with less than `alike_from` of the lit cubes' mean they sum to less than 1, in proportion to the lit area.
    """
    cubes = (means / side_m).floor().long()
    x, y, z = (cubes - cubes.amin(0)).unbind(1)
    _, cube = ((x * (y.max() + 1) + y) * (z.max() + 1) + z).unique(return_inverse=True)
    scale = exact_scale(lit[:, None])
    whole = torch.zeros_like(cube).index_add_(0, cube, (lit * scale).long())
    least = alike_from * whole.sum() / whole.count_nonzero().clamp(min=1) / scale
    return lit / (whole / scale).clamp(min=least.clamp(min=torch.finfo(lit.dtype).tiny))[cube]


def pairs(
    shares: Float64[Tensor, " n"], idle_share: float, generator: torch.Generator
) -> tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]:
    """Indices of the idle Gaussians, and of the one that each joins; no index is in both.

    Idle are those with the least shares, at most `idle_share` of the sum; others are joined in proportion to theirs.
    """
    order = shares.argsort(stable=True)
    held = running_sums(shares[order])
    idle = order[held <= idle_share * held[-1]][: len(order) // 2]
    weights = shares.index_fill(0, idle, 0.0)
    idle = idle[: int((weights > 0).sum())]
    if not len(idle):
        return idle, idle
    # as `torch.multinomial` does on the CPU, with the same numbers on every device
    chance = torch.empty(len(shares), dtype=torch.float64, device="cpu").exponential_(generator=generator)
    return idle, (weights / chance.to(weights.device)).topk(len(idle)).indices
