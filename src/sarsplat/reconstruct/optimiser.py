"""Adam over named parameters, with rates that decay, bounds, and rows that come and go."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.reconstruct.config import Config
from sarsplat.reconstruct.model import PER_GAUSSIAN
from sarsplat.render import cpu

_NUISANCE = "nuisance"
_BETA1, _BETA2, _EPSILON = 0.9, 0.99, 1e-15
_MOMENTS = ("exp_avg", "exp_avg_sq")
_UNBOUNDED = (torch.tensor(-torch.inf), torch.tensor(torch.inf))


def learning_rate(name: str, iteration: int, config: Config) -> float:
    """Rate of one parameter: means decay exponentially throughout, the rest tenfold over the second half."""
    done = iteration / config.iterations
    rates = config.rates
    if name == "means":
        return rates.means * (rates.means_end / rates.means) ** done
    return getattr(rates, name if name in PER_GAUSSIAN else _NUISANCE) * 0.1 ** max(0.0, 2 * done - 1)


class Optimiser:
    """One Adam for all parameters, in one call of the engine; its moments are saved, restored and re-indexed with them.

    Parameters
    ----------
    parameters : dict of str to Tensor
        Leaves, float32 and contiguous; stepped in place.
    bounds : dict of str to (Tensor, Tensor)
        Range that a parameter is brought back into after each step: two numbers, or two for each column.
    config : Config
        Rates and their decay.
    """

    def __init__(self, parameters: dict[str, Tensor], bounds: dict[str, tuple[Tensor, Tensor]], config: Config) -> None:
        self._config, self._parameters, self._bounds = config, parameters, bounds
        self._moments = {
            f"{name}/{moment}": torch.zeros_like(tensor, requires_grad=False)
            for name, tensor in parameters.items()
            for moment in _MOMENTS
        }
        self._steps = dict.fromkeys(parameters, 0)

    def step(self, iteration: int) -> None:
        """One update of what has a gradient, with the rates of this iteration; gradients are cleared."""
        groups, gradients = [], []
        for name, tensor in self._parameters.items():
            if tensor.grad is None:
                continue
            self._steps[name] += 1
            gradients.append(tensor.grad.contiguous())  # kept alive until the call is over
            groups.append(self._group(name, tensor, gradients[-1], learning_rate(name, iteration, self._config)))
            tensor.grad = None
        cpu.adam(groups, _BETA1, _BETA2, _EPSILON)
        # the engine wrote behind torch's back: whoever kept the old values for a backward pass is told
        torch.autograd.graph.increment_version(list(self._parameters.values()))

    def _group(self, name: str, tensor: Tensor, gradient: Tensor, rate: float) -> ctypes.Structure:
        mean, square = (self._moments[f"{name}/{moment}"] for moment in _MOMENTS)
        low, high = (bound.view(-1).tolist() for bound in self._bounds.get(name, _UNBOUNDED))
        step = self._steps[name]
        return cpu.AdamGroup(
            *(array.data_ptr() for array in (tensor, gradient, mean, square)),
            tensor.numel(),
            len(low),
            rate,
            _BETA1**step,
            _BETA2**step,
            tuple(low),
            tuple(high),
        )

    def rebuild(self, parameters: dict[str, Tensor], source: Int64[Tensor, " n"]) -> Optimiser:
        """The optimiser of parameters whose rows changed.

        Parameters
        ----------
        parameters : dict of str to Tensor
            The new leaves.
        source : Tensor, int64 [N]
            Row whose moments a new row inherits, or −1 to start from rest; what is not per Gaussian keeps its own.
        """
        state = self.state()
        fresh = Optimiser(parameters, self._bounds, self._config)
        moved = {}
        for key, value in state.items():
            name = key.split("/")[0]
            if name in PER_GAUSSIAN and value.ndim:
                value = torch.where((source >= 0).view(-1, *[1] * (value.ndim - 1)), value[source.clamp(min=0)], 0.0)
            moved[key] = value
        fresh.load_state(moved)
        return fresh

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts by `parameter/moment`, of the parameters that were ever stepped."""
        state = {key: tensor for key, tensor in self._moments.items() if self._steps[key.split("/")[0]]}
        return state | {f"{name}/step": torch.tensor(float(steps)) for name, steps in self._steps.items() if steps}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Undo `state`."""
        for name, tensor in self._parameters.items():
            if f"{name}/step" not in state:
                continue
            self._steps[name] = int(state[f"{name}/step"])
            if self._steps[name] < 1:
                raise ValueError(f"{name} was stepped {self._steps[name]} times")
            for moment in _MOMENTS:
                value = state[f"{name}/{moment}"]
                if value.shape != tensor.shape or value.dtype != torch.float32:
                    raise ValueError(f"{name}/{moment} is {value.dtype} {list(value.shape)}")
                self._moments[f"{name}/{moment}"] = value.detach().clone(memory_format=torch.contiguous_format)
