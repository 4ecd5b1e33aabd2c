"""Collective steps: neighbours move together along the sum of their gradients, and all change their scattering alike.

A bulge of a uniform surface changes each Gaussian's gradient by less than its noise, so that steps of single Gaussians
do not remove it. In the sum over a neighbourhood it stands out; so does a wrong scattering law in the sum over all.
"""

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sarsplat.data import Dataset
from sarsplat.gaussians.initialise import Region
from sarsplat.learning.optimiser import BETA1, BETA2, EPSILON, Optimiser
from sarsplat.learning.parts.part import column_means, exact_scale
from sarsplat.learning.strategies.strategy import Configured, Info, Params, State
from sarsplat.settings.config import Config

_PITCHES = (4, 8)  # spacings of the nodes of the lattices, in resolution cells
_EVERY = 4  # steps between two moves, each as long as those steps together


class CollectiveSteps(Configured):
    """Adam's steps on the nodes of two lattices, at full resolution; Gaussians follow by trilinear interpolation.

    Coarser images do not resolve what a node moves, such as a house. Steps shrink to zero, so that edges, which are
    carried along, return to their places. Mean squares begin at 0: the first moves, of the largest bulges, are longer.
    From `Config.law_from` on, at all levels, all scattering takes Adam's step by the mean of its gradients.
    """

    order = 8
    name = "collective"
    section = "smoothing"

    @classmethod
    def wanted(cls, config: Config, train: Dataset) -> bool:
        return config.smoothing.collective > 0 and config.smoothing.rounds > 0 and config.coarsest > 1

    def initial_state(self, params: Params) -> State:
        means, scattering = params["means"].detach(), params["scattering"].detach()
        moments = {str(pitch): means.new_zeros(0, 4) for pitch in _PITCHES}
        moments["scattering"] = scattering.new_zeros(1, 2 * scattering.shape[1])
        return State(whole=moments, added=("scattering",))

    @torch.no_grad()
    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        levels, frame = info.model.levels, info.model.frame
        if levels.coarsest == 1 or step % _EVERY:  # vehicles have no large surfaces
            return
        if step >= info.model.config.law_from * levels.iterations:
            steps = _steps(column_means(optimizers.state["scattering"]["exp_avg"])[None], state.whole["scattering"])
            how = info.model.learned["scattering"]
            rates = steps.new_tensor(how.rates) * how.decay((step - 1) / levels.iterations)
            params["scattering"].detach().sub_(_EVERY * rates * steps)
        if levels.factor(step - 1) > 1:
            return
        means, moves = params["means"].detach(), torch.zeros_like(params["means"])
        for pitch in _PITCHES:
            lattice = Lattice.around(frame.region, pitch * frame.cell_m, means)
            if len(state.whole[str(pitch)]) != lattice.count:
                state.whole[str(pitch)] = means.new_zeros(lattice.count, 4)
            steps = _steps(lattice.sums(optimizers.state["means"]["exp_avg"]), state.whole[str(pitch)])
            moves -= lattice.interpolated(steps)
        means += _EVERY * self.settings.collective * levels.left(step) * frame.cell_m * moves
        optimizers.constrain()


def _steps(mean: Float[Tensor, "n k"], moments: Float[Tensor, "n _"]) -> Float[Tensor, "n k"]:
    """Steps of Adam by means of gradients, which decay as those of single Gaussians do; to be subtracted.

    `moments`, updated in place, are the last `mean`, and then mean squares: one for each column, or one for all.
    """
    beta1, beta2 = BETA1**_EVERY, BETA2**_EVERY
    before, square = moments.split((mean.shape[1], moments.shape[1] - mean.shape[1]), dim=1)
    gradient = (mean - beta1 * before) / (1 - beta1)  # mean of the gradients since, which the momentum contains
    squares = gradient**2 if square.shape == mean.shape else (gradient**2).sum(1, keepdim=True)
    before.copy_(mean)
    square.mul_(beta2).add_(squares, alpha=1 - beta2)
    return mean / (square.sqrt() + EPSILON)


@dataclass(frozen=True)
class Lattice:
    """Nodes of a lattice around a region, and the eight of them around each Gaussian with trilinear weights."""

    count: int
    """Number of nodes."""
    nodes: Int64[Tensor, "8 n"]
    weights: Float[Tensor, "8 n 1"]

    @classmethod
    def around(cls, region: Region, pitch_m: float, places: Float[Tensor, "n 3"]) -> "Lattice":
        shape = [math.ceil(length) + 2 for length in (region.high - region.low) / pitch_m]
        steps = ((places - places.new_tensor(region.low)) / pitch_m).clamp(min=0)
        lower = torch.minimum(steps.floor(), steps.new_tensor(shape) - 2)
        share, (x, y, z) = (steps - lower).clamp(max=1), lower.long().unbind(1)
        nodes, weights = [], []
        for dx, dy, dz in itertools.product((0, 1), repeat=3):
            nodes.append(((x + dx) * shape[1] + y + dy) * shape[2] + z + dz)
            upper = torch.tensor([dx, dy, dz], dtype=torch.bool, device=places.device)
            weights.append(torch.where(upper, share, 1 - share).prod(1, keepdim=True))
        return cls(math.prod(shape), torch.stack(nodes), torch.stack(weights))

    def sums(self, values: Float[Tensor, "n k"]) -> Float[Tensor, "count k"]:
        """Sum the Gaussians' values at the nodes, with their weights; as whole numbers, whose order does not matter."""
        scale = exact_scale(values)
        total = torch.zeros(self.count, values.shape[1], dtype=torch.int64, device=values.device)
        for nodes, weights in zip(self.nodes, self.weights, strict=True):
            total.index_add_(0, nodes, (weights * values * scale).long())
        return (total / scale).to(values.dtype)

    def interpolated(self, values: Float[Tensor, "count k"]) -> Float[Tensor, "n k"]:
        """Interpolate values of the nodes at the Gaussians."""
        return sum(weights * values[nodes] for nodes, weights in zip(self.nodes, self.weights, strict=True))
