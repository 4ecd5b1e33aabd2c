"""Adam over named parameters, with rates that decay, bounds, and rows that come and go."""

from __future__ import annotations

from functools import partial

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.reconstruction import adam, fused
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.model import LENGTHS, LOGARITHMIC, PER_GAUSSIAN, PRIORS

_MOMENTS = ("exp_avg", "exp_avg_sq")
_UNBOUNDED = tuple(torch.tensor(bound, device="cpu") for bound in (-torch.inf, torch.inf))


def learning_rate(name: str, column: int, config: Config, cell_m: float) -> float:
    """First rate of one column of a parameter; of means and shifts in m. 0 for what keeps its value."""
    if name in PRIORS and config.surroundings and not getattr(config.surroundings, PRIORS[name]):
        return 0.0
    if name == "ground_texture":
        return config.rates.ground
    if name == "scattering" and column > 0:
        return config.rates.directional_scattering
    if name in LOGARITHMIC:
        return getattr(config.rates, f"log_{name}")
    if name in LENGTHS:
        return getattr(config.rates, name) * cell_m
    return getattr(config.rates, name if name in PER_GAUSSIAN else "nuisance")


def decay(name: str, iteration: int, config: Config) -> float:
    """Factor on a parameter's rates: of means it falls exponentially throughout, else tenfold over the second half."""
    done = iteration / config.iterations
    if name == "means":
        return (config.rates.means_end / config.rates.means) ** done
    return 0.1 ** max(0.0, 2 * done - 1)


class Optimiser:
    """Adam for all parameters of a training; its moments are saved, restored and re-indexed with them.

    On the CPU a step is one call of the engine, elsewhere it is plain torch.

    Parameters
    ----------
    parameters : dict of str to Tensor
        Leaves, float32, contiguous and on one device, of at most 16 columns; stepped in place, some of them by their
        logarithm.
    bounds : dict of str to (Tensor, Tensor)
        Range that a parameter is brought back into after each step: two numbers, or two for each column.
    config : Config
        Rates and their decay.
    cell_m : float
        Resolution cell of the images, m: rates of lengths are multiples of it.
    """

    def __init__(
        self, parameters: dict[str, Tensor], bounds: dict[str, tuple[Tensor, Tensor]], config: Config, cell_m: float
    ) -> None:
        self._config, self._parameters, self._bounds, self._cell_m = config, parameters, bounds, cell_m
        self._steps = 0
        self._moments = {
            f"{name}/{moment}": torch.zeros_like(tensor, requires_grad=False)
            for name, tensor in parameters.items()
            for moment in _MOMENTS
        }
        tensors = [self._stepped(name, tensor) for name, tensor in parameters.items()]
        self._adam = fused.Adam(tensors).step if fused.takes(parameters.values()) else partial(adam.step, tensors)

    def _stepped(self, name: str, tensor: Tensor) -> adam.Stepped:
        mean, square = (self._moments[f"{name}/{moment}"] for moment in _MOMENTS)
        columns = tensor[0].numel()
        rates = [learning_rate(name, column, self._config, self._cell_m) for column in range(columns)]
        bounds = self._bounds.get(name, _UNBOUNDED)
        low, high = (bound.to(tensor).expand(columns) for bound in bounds)
        return adam.Stepped(tensor, mean, square, tensor.new_tensor(rates), low, high, name in LOGARITHMIC)

    def rates(self, iteration: int) -> dict[str, float]:
        """Rates of this iteration by parameter, each of its first column; of means and shifts in m."""
        return {
            name: learning_rate(name, 0, self._config, self._cell_m) * decay(name, iteration, self._config)
            for name in self._parameters
        }

    def step(self, iteration: int) -> None:
        """One update, with the rates of this iteration; gradients are cleared."""
        self._steps += 1
        gradients = []
        for name, tensor in self._parameters.items():
            if tensor.grad is None:
                raise ValueError(f"{name} has no gradient")
            gradients.append(tensor.grad)
            tensor.grad = None
        self._adam(gradients, [decay(name, iteration, self._config) for name in self._parameters], self._steps)

    def rebuild(self, parameters: dict[str, Tensor], source: Int64[Tensor, " n"]) -> Optimiser:
        """The optimiser of parameters whose rows changed.

        Parameters
        ----------
        parameters : dict of str to Tensor
            The new leaves.
        source : Tensor, int64 [N]
            Row whose moments a new row inherits, or −1 to start from rest; what is not per Gaussian keeps its own.
        """
        moved = self.state()
        for key, value in self._moments.items():
            if key.split("/")[0] in PER_GAUSSIAN:
                inherits = (source >= 0).view(-1, *[1] * (value.ndim - 1))
                moved[key] = torch.where(inherits, value[source.clamp(min=0)], 0.0)
        fresh = Optimiser(parameters, self._bounds, self._config, self._cell_m)
        fresh.load_state(moved)
        return fresh

    def state(self) -> dict[str, Tensor]:
        """Moments by `parameter/moment`, and how many steps they are of."""
        return self._moments | {"step": torch.tensor(float(self._steps), device="cpu")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Undo `state`."""
        self._steps = int(state["step"])
        if self._steps < 0:
            raise ValueError(f"the optimiser made {self._steps} steps")
        for key, moment in self._moments.items():
            if state[key].shape != moment.shape or state[key].dtype != torch.float32:
                raise ValueError(f"{key} is {state[key].dtype} {list(state[key].shape)}")
            moment.copy_(state[key])
