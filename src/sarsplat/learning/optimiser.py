"""Adam for named parameters, with decaying rates, ranges, and rows that come and go."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sarsplat.learning.parts.part import Learned
from sarsplat.learning.snapshot import fitting
from sarsplat.renderer.engines.abi import api, filled
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.passes import NewPass

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15

_LARGEST_FACTOR = 2.0**99
"""Largest factor of one step on a positive parameter: it reaches its bounds and stays within float32."""

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
        self._adam: EngineAdam | PlainAdam | None = None
        self._source: Int64[Tensor, " n"] | None = None  # of each row since the last `take_moves`

    @property
    def rows(self) -> list[str]:
        """Names of the parameters with a row for each Gaussian."""
        return [name for name in self._parameters if self._learned[name].per_gaussian]

    def _stepped(self, name: str, tensor: Tensor) -> "Stepped":
        learned = self._learned[name]
        mean, square = self.state[name].values()
        rates, low, high = (
            torch.as_tensor(numbers, dtype=tensor.dtype, device="cpu").to(tensor.device).expand(tensor[0].numel())
            for numbers in (learned.rates, learned.low, learned.high)
        )
        return Stepped(tensor, mean, square, rates, low, high, learned.logarithmic)

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
    def stepper(self) -> "EngineAdam | PlainAdam":
        """Adam for the current tensors, rates and ranges; made anew when these change."""
        if self._adam is None:
            tensors = [self._stepped(name, tensor) for name, tensor in self._parameters.items()]
            new_pass, columns = passes_for("auto", self._parameters), max(len(tensor.rates) for tensor in tensors)
            if new_pass is not None and new_pass().has("adam", {"columns": columns}):
                self._adam = EngineAdam(new_pass, tensors)
            else:
                self._adam = PlainAdam(tensors)
        return self._adam

    def numbers(self, iteration: int) -> list[float]:
        """Decays and powers of the next step, for `EngineAdam.step_on_device`."""
        return [*(self._decay(name, iteration) for name in self._parameters), *powers(self._steps + 1)]

    def stepped(self) -> None:
        """Count a step made by a CUDA graph."""
        self._steps += 1

    @torch.no_grad()
    def constrain(self) -> None:
        """Clamp every parameter to its range."""
        for tensor in self.stepper.tensors:
            tensor.value.clamp_(tensor.low, tensor.high)

    def follow(self, source: Int64[Tensor, " n"], kept: Bool[Tensor, " n"]) -> None:
        """Re-index the moments: row k takes those of row `source`[k], or 0 where not `kept`[k] (a new Gaussian)."""
        for name in self.rows:
            moments = {moment: followed(value, source, kept) for moment, value in self.state[name].items()}
            if len(source) == len(self.state[name][_MOMENTS[0]]):
                for moment, value in moments.items():
                    self.state[name][moment].copy_(value)
            else:
                self.state[name], self._adam = moments, None
        before = source if self._source is None else self._source[source]
        self._source = torch.where(kept, before, -1)

    def take_moves(self) -> Int64[Tensor, " n"] | None:
        """Index of each row at the last call, −1 for a new row; None if no rows have moved since."""
        source, self._source = self._source, None
        return source

    def tensors(self) -> dict[str, Tensor]:
        """Adam's moments as `parameter/moment`, and the number of steps, to be saved."""
        moments = {f"{name}/{key}": value for name, own in self.state.items() for key, value in own.items()}
        return moments | {"step": torch.tensor(float(self._steps), dtype=torch.float32, device="cpu")}

    def load(self, tensors: dict[str, Tensor]) -> None:
        self._steps = int(tensors["step"])
        if self._steps < 0:
            raise ValueError(f"the optimiser made {self._steps} steps")
        for name, moments in self.state.items():
            for moment, value in moments.items():
                value.copy_(fitting(tensors, f"{name}/{moment}", torch.float32, value.shape))


def followed(rows: Tensor, source: Int64[Tensor, " n"], kept: Bool[Tensor, " n"]) -> Tensor:
    """Rows of a per-Gaussian tensor in a new order; 0 where not `kept`."""
    return torch.where(kept.view(-1, *[1] * (rows.ndim - 1)), rows[source], 0.0)


@dataclass(frozen=True)
class Stepped:
    """A parameter with its moments, changed in place, and the rate and range of each column ([1] if it has none).

    All on one device and of one floating dtype. `logarithmic`: step the logarithm of a positive value.
    """

    value: Float[Tensor, "*shape"]
    mean: Float[Tensor, "*shape"]
    square: Float[Tensor, "*shape"]
    rates: Float[Tensor, " k"]
    low: Float[Tensor, " k"]
    high: Float[Tensor, " k"]
    logarithmic: bool


class PlainAdam:
    """Adam in plain torch, on any device, without waiting for it."""

    def __init__(self, tensors: Sequence[Stepped]) -> None:
        self.tensors = tensors

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], decays: Sequence[float], count: int) -> None:
        """Make step `count` (from 1) and clamp parameters to their ranges; `decays` are factors on the rates."""
        rate, spread = 1 / (1 - BETA1**count), 1 / math.sqrt(1 - BETA2**count)
        max_log_factor = math.log(_LARGEST_FACTOR)
        for tensor, gradient, decay in zip(self.tensors, gradients, decays, strict=True):
            slope = gradient * tensor.value if tensor.logarithmic else gradient
            tensor.mean.lerp_(slope, 1 - BETA1)
            tensor.square.mul_(BETA2).addcmul_(slope, slope, value=1 - BETA2)
            down = tensor.mean / (tensor.square.sqrt() * spread + EPSILON) * (tensor.rates * (decay * rate))
            value = tensor.value
            moved = value * (-down).clamp(-max_log_factor, max_log_factor).exp() if tensor.logarithmic else value - down
            value.copy_(moved.clamp(tensor.low, tensor.high))  # NaN stays NaN: the next rendering says so


class EngineAdam:
    """Adam by an engine, which writes the parameters' memory in place."""

    def __init__(self, new_pass: NewPass, tensors: Sequence[Stepped]) -> None:
        self._new_pass, self.tensors = new_pass, tensors  # kept alive: the engine has their addresses only
        constants = {"count": len(tensors), "beta1": BETA1, "beta2": BETA2, "epsilon": EPSILON}
        self._call = filled(api.adam_step, constants | {"groups": [_group(tensor) for tensor in tensors]})
        self._groups = self._call.groups[: len(tensors)]

    def step(self, gradients: Sequence[Tensor], decays: Sequence[float], count: int) -> None:
        """Make a step, like `PlainAdam`."""
        for group, decay in zip(self._groups, decays, strict=True):
            group.decay = decay
        self._call.beta1_power, self._call.beta2_power = powers(count)
        self._call.now = None  # no tensor on the device replaces decays and powers
        self._run(gradients)

    def step_on_device(self, gradients: Sequence[Tensor], decays_and_powers: Float[Tensor, " n"]) -> None:
        """Make a step that reads the decays, then the `powers`, from a tensor on the device (for CUDA graphs)."""
        self._call.now = decays_and_powers.data_ptr()
        self._run(gradients)

    def _run(self, gradients: Sequence[Tensor]) -> None:
        gradients = [gradient.contiguous() for gradient in gradients]  # kept alive until the call is over
        for group, gradient in zip(self._groups, gradients, strict=True):
            group.gradient = gradient.data_ptr()
        self._new_pass().run("adam", self._call)
        self.mark_changed()

    def mark_changed(self) -> None:
        """Notify autograd of the in-place changes, so that a backward pass with old values raises."""
        torch.autograd.graph.increment_version([tensor.value for tensor in self.tensors])


def powers(count: int) -> tuple[float, float]:
    """β₁ and β₂ to the power of `count`: the bias of the moments in step `count`."""
    return BETA1**count, BETA2**count


def _group(tensor: Stepped) -> dict[str, Any]:
    ranges = {"rate": tensor.rates, "low": tensor.low, "high": tensor.high}
    return {
        **{"value": tensor.value, "mean": tensor.mean, "square": tensor.square, "logarithmic": tensor.logarithmic},
        **{"rows": len(tensor.value), "columns": len(tensor.rates)},
        **{name: tuple(numbers.tolist()) for name, numbers in ranges.items()},
    }
