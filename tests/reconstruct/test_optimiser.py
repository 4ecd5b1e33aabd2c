"""The engine's Adam against torch's, step for step."""

from __future__ import annotations

import math

import pytest
import torch

from sarsplat.reconstruct import optimiser as module
from sarsplat.reconstruct.config import preset
from sarsplat.reconstruct.optimiser import Optimiser, learning_rate
from sarsplat.render import cpu

BUILT = cpu.INSTRUCTION_SETS[1:]
AVAILABLE = BUILT[: BUILT.index(cpu.best_instruction_set()) + 1]
# more than one task, a tail in the last vector, three and fifteen columns
SHAPES = {"means": (6001, 3), "quaternions": (7, 4), "log_optical_depth": (1,), "higher_harmonics": (333, 15)}
BOUNDS = {
    "means": (torch.tensor([-1.0, -0.5, 0.0]), torch.tensor([1.0, 0.5, 2.0])),
    "log_optical_depth": (torch.tensor(-0.01), torch.tensor(0.01)),
}


def leaves() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return {name: torch.randn(shape, generator=generator).requires_grad_() for name, shape in SHAPES.items()}


def test_every_step_is_torchs(instruction_set: str) -> None:
    config = preset("default")
    mine, theirs = leaves(), leaves()
    optimiser = Optimiser(mine, BOUNDS, config)
    groups = [{"params": [tensor], "name": name} for name, tensor in theirs.items()]
    adam = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15)
    generator = torch.Generator().manual_seed(4)
    for iteration in range(30):
        for name in SHAPES:
            if name == "higher_harmonics" and iteration < 10:
                continue  # unused at first: it counts no steps
            gradient = torch.randn(SHAPES[name], generator=generator) * 10.0 ** (iteration % 9 - 6)
            mine[name].grad, theirs[name].grad = gradient.clone(), gradient
        for group in adam.param_groups:
            group["lr"] = learning_rate(group["name"], iteration, config)
        optimiser.step(iteration)
        adam.step()
        with torch.no_grad():
            for name, (low, high) in BOUNDS.items():
                theirs[name].clamp_(low, high)
        for name in SHAPES:
            assert mine[name].grad is None
            assert torch.allclose(mine[name], theirs[name], rtol=1e-5, atol=1e-6), (name, iteration)
    for name in SHAPES:
        for moment in ("exp_avg", "exp_avg_sq"):
            found, expected = optimiser.state()[f"{name}/{moment}"], adam.state[theirs[name]][moment]
            assert float((found - expected).norm() / expected.norm()) < 3e-6
        assert float(optimiser.state()[f"{name}/step"]) == (20 if name == "higher_harmonics" else 30)


@pytest.fixture(params=AVAILABLE)
def instruction_set(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each that this processor has."""
    adam = cpu.adam
    monkeypatch.setattr(module.cpu, "adam", lambda *arguments: adam(*arguments, instruction_set=request.param))
    return request.param


def test_values_changed_behind_a_backward_pass_are_noticed() -> None:
    parameters = {"means": torch.ones(4, 3, requires_grad=True)}
    optimiser = Optimiser(parameters, {}, preset("default"))
    square = (parameters["means"] ** 2).sum()
    parameters["means"].grad = torch.ones(4, 3)
    optimiser.step(0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        square.backward()


def test_state_comes_back() -> None:
    def trained(optimiser: Optimiser, parameters: dict[str, torch.Tensor], first: int, last: int) -> None:
        for iteration in range(first, last):
            for tensor in parameters.values():
                tensor.grad = torch.full_like(tensor, math.sin(iteration))
            optimiser.step(iteration)

    config = preset("default")
    whole, part = leaves(), leaves()
    trained(Optimiser(whole, BOUNDS, config), whole, 0, 6)
    first = Optimiser(part, BOUNDS, config)
    trained(first, part, 0, 3)
    second = Optimiser(part, BOUNDS, config)
    second.load_state(first.state())
    trained(second, part, 3, 6)
    for name in SHAPES:
        assert torch.equal(whole[name], part[name])
