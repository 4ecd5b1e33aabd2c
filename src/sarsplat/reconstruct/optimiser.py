"""Adam over named parameters, with rates that decay and rows that come and go."""

from __future__ import annotations

import torch
from jaxtyping import Int64
from torch import Tensor

from sarsplat.reconstruct.config import Config
from sarsplat.reconstruct.model import PER_GAUSSIAN

_NUISANCE = "nuisance"


def learning_rate(name: str, iteration: int, config: Config) -> float:
    """Rate of one parameter: means decay exponentially throughout, the rest tenfold over the second half."""
    done = iteration / config.iterations
    rates = config.rates
    if name == "means":
        return rates.means * (rates.means_end / rates.means) ** done
    return getattr(rates, name if name in PER_GAUSSIAN else _NUISANCE) * 0.1 ** max(0.0, 2 * done - 1)


class Optimiser:
    """One Adam for all parameters; its moments are saved, restored and re-indexed with them."""

    def __init__(self, parameters: dict[str, Tensor], config: Config) -> None:
        self._config = config
        groups = [{"params": [tensor], "name": name} for name, tensor in parameters.items()]
        self._adam = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def step(self, iteration: int) -> None:
        """One update with the rates of this iteration; gradients are cleared."""
        for group in self._adam.param_groups:
            group["lr"] = learning_rate(group["name"], iteration, self._config)
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

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
        fresh = Optimiser(parameters, self._config)
        moved = {}
        for key, value in state.items():
            name = key.split("/")[0]
            if name in PER_GAUSSIAN and value.ndim:
                value = torch.where((source >= 0).view(-1, *[1] * (value.ndim - 1)), value[source.clamp(min=0)], 0.0)
            moved[key] = value
        fresh.load_state(moved)
        return fresh

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts by `parameter/moment`."""
        return {
            f"{group['name']}/{moment}": value
            for group in self._adam.param_groups
            for moment, value in self._adam.state[group["params"][0]].items()
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Undo `state`."""
        for group in self._adam.param_groups:
            prefix = f"{group['name']}/"
            found = {key.removeprefix(prefix): value.clone() for key, value in state.items() if key.startswith(prefix)}
            self._adam.state[group["params"][0]] = found
