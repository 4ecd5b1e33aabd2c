"""Adam for named parameters, with decaying rates, ranges, and rows that come and go."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sarsplat.learning import adam
from sarsplat.learning.parts.part import Learned
from sarsplat.renderer.engines.choice import passes_for

_MOMENTS = ("exp_avg", "exp_avg_sq")


class Optimiser:
    """Adam for all parameters of a training of `iterations` steps; moments are saved, restored and re-indexed.

    Steps are in place, by the device's engine or in plain torch. Parameters are float32 leaves, contiguous and on one
    device; after `follow` the dictionary must hold the new ones.
    """

    def __init__(self, parameters: dict[str, Tensor], learned: Mapping[str, Learned], iterations: int) -> None:
        self._parameters, self._learned, self._iterations = parameters, learned, iterations
        self.state = {  # moments of each parameter, shaped like it
            name: {moment: torch.zeros_like(tensor, requires_grad=False) for moment in _MOMENTS}
            for name, tensor in parameters.items()
        }
        self._steps = 0
        self._adam: adam.EngineAdam | adam.PlainAdam | None = None
        self._source: Int64[Tensor, " n"] | None = None

    @property
    def rows(self) -> list[str]:
        """Names of the parameters with a row for each Gaussian."""
        return [name for name in self._parameters if self._learned[name].per_gaussian]

    def _columns(self, name: str, numbers: tuple[float, ...] | Tensor | float) -> Float[Tensor, " k"]:
        """A number for each column of a parameter."""
        tensor = self._parameters[name]
        columns = torch.as_tensor(numbers, dtype=tensor.dtype, device="cpu").to(tensor.device)
        return columns.expand(tensor[0].numel())

    def _stepped(self, name: str, tensor: Tensor) -> adam.Stepped:
        learned = self._learned[name]
        mean, square = self.state[name].values()
        rates, low, high = (self._columns(name, numbers) for numbers in (learned.rates, learned.low, learned.high))
        return adam.Stepped(tensor, mean, square, rates, low, high, learned.logarithmic)

    def relearn(self, learned: Mapping[str, Learned]) -> None:
        """Replace rates and ranges."""
        self._learned, self._adam = learned, None

    def rates(self, iteration: int) -> dict[str, float]:
        """Learning rates of this iteration by parameter, of the first column; those of means and shifts are in m."""
        return {name: self._learned[name].rates[0] * self._decay(name, iteration) for name in self._parameters}

    def _decay(self, name: str, iteration: int) -> float:
        return self._learned[name].decay(iteration / self._iterations)

    def step(self, iteration: int) -> None:
        """Make one step with the rates of this iteration and clear the gradients."""
        gradients = []
        for name, tensor in self._parameters.items():
            if tensor.grad is None:
                raise ValueError(f"{name} has no gradient")
            gradients.append(tensor.grad)
            tensor.grad = None
        self._steps += 1
        self.stepper.step(gradients, [self._decay(name, iteration) for name in self._parameters], self._steps)

    @property
    def stepper(self) -> adam.EngineAdam | adam.PlainAdam:
        """Adam for the current tensors, rates and ranges; made anew when these change."""
        if self._adam is None:
            tensors = [self._stepped(name, tensor) for name, tensor in self._parameters.items()]
            self._adam = adam.stepper(passes_for("auto", self._parameters), tensors)
        return self._adam

    def numbers(self, iteration: int) -> list[float]:
        """Decays and powers of the next step, for `EngineAdam.step_on_device`."""
        return [*(self._decay(name, iteration) for name in self._parameters), *adam.powers(self._steps + 1)]

    def stepped(self) -> None:
        """Count a step made by a CUDA graph."""
        self._steps += 1

    @torch.no_grad()
    def constrain(self) -> None:
        """Clamp every parameter to its range."""
        for name, tensor in self._parameters.items():
            tensor.clamp_(self._columns(name, self._learned[name].low), self._columns(name, self._learned[name].high))

    def follow(self, source: Int64[Tensor, " n"], kept: Bool[Tensor, " n"]) -> None:
        """Re-index the moments: row k takes those of row `source`[k], or 0 where not `kept`[k] (a new Gaussian)."""
        for name in self.rows:
            moments = {moment: followed(value, source, kept) for moment, value in self.state[name].items()}
            if len(source) == len(self.state[name][_MOMENTS[0]]):
                for moment, value in moments.items():
                    self.state[name][moment].copy_(value)
            else:
                self.state[name], self._adam = moments, None
        inherited = torch.where(kept, source, -1)
        if self._source is not None:
            inherited = torch.where(kept, self._source[source], -1)
        self._source = inherited

    def take_moves(self) -> Int64[Tensor, " n"] | None:
        """Index of each row at the last call, −1 for a new row; None if no rows have moved since."""
        source, self._source = self._source, None
        return source

    def tensors(self) -> dict[str, Tensor]:
        """Adam's moments as `parameter/moment`, and the number of steps, to be saved."""
        moments = {f"{name}/{moment}": value for name, of in self.state.items() for moment, value in of.items()}
        return moments | {"step": torch.tensor(float(self._steps), dtype=torch.float32, device="cpu")}

    def load(self, tensors: dict[str, Tensor]) -> None:
        self._steps = int(tensors["step"])
        if self._steps < 0:
            raise ValueError(f"the optimiser made {self._steps} steps")
        for name, of in self.state.items():
            for moment, value in of.items():
                saved = tensors[f"{name}/{moment}"]
                if saved.shape != value.shape or saved.dtype != torch.float32:
                    raise ValueError(f"{name}/{moment} is {saved.dtype} {list(saved.shape)}")
                value.copy_(saved)


def followed(rows: Tensor, source: Int64[Tensor, " n"], kept: Bool[Tensor, " n"]) -> Tensor:
    """Rows of a per-Gaussian tensor in a new order; 0 where not `kept`."""
    return torch.where(kept.view(-1, *[1] * (rows.ndim - 1)), rows[source], 0.0)
