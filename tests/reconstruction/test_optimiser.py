"""The engine's Adam and the one in plain torch against torch's own, step for step."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from sarsplat.reconstruction import fused
from sarsplat.reconstruction.optimiser import Optimiser, decay, learning_rate
from sarsplat.reconstruction.presets import preset
from sarsplat.renderer import cpu

BUILT = cpu.INSTRUCTION_SETS[1:]
AVAILABLE = BUILT[: BUILT.index(cpu.best_instruction_set()) + 1]
# more than one task, a tail in the last vector, one to sixteen columns
SHAPES = {"means": (6001, 3), "quaternions": (7, 4), "optical_depth": (1,), "scattering": (333, 16)}
CELL_M = 0.3
BOUNDS = {
    "means": (torch.tensor([-1.0, -0.5, 0.0]), torch.tensor([1.0, 0.5, 2.0])),
    "optical_depth": (torch.tensor(0.99), torch.tensor(1.01)),
}


def leaves() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    leaves = {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}
    leaves["optical_depth"].fill_(1.0)
    return {name: tensor.requires_grad_() for name, tensor in leaves.items()}


def test_a_gradient_that_is_not_a_number_does_not_become_a_bound(how: str) -> None:
    mine = leaves()
    optimiser = Optimiser(mine, BOUNDS, preset("default"), CELL_M)
    for name, tensor in mine.items():
        tensor.grad = torch.full_like(tensor, math.nan if name in BOUNDS else 0.0)
    optimiser.step(0)
    assert all(mine[name].isnan().all() for name in BOUNDS)  # the next rendering says so


def test_every_step_is_torchs(how: str) -> None:
    config = preset("default")
    mine = leaves()
    optimiser = Optimiser(mine, BOUNDS, config, CELL_M)
    theirs = {name: tensor.detach().clone() for name, tensor in mine.items()}
    theirs["optical_depth"].log_()  # what is stepped is its logarithm
    low, high = BOUNDS["optical_depth"]
    bounds = BOUNDS | {"optical_depth": (low.log(), high.log())}
    columns = {  # one to a group of torch's: each has its rate
        (name, k): tensor.view(len(tensor), -1)[:, k].requires_grad_()
        for name, tensor in theirs.items()
        for k in range(tensor[0].numel())
    }
    groups = [{"params": [tensor], "column": key} for key, tensor in columns.items()]
    adam = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15)
    generator = torch.Generator().manual_seed(4)
    for iteration in range(30):
        for name, shape in SHAPES.items():
            gradient = torch.randn(shape, generator=generator) * 10.0 ** (iteration % 9 - 6)
            if name == "scattering" and iteration < 10:
                gradient[:, 1:] = 0.0  # higher degrees are not used at first
            mine[name].grad = gradient.clone()
            if name == "optical_depth":
                gradient *= mine[name].detach()
            for k in range(gradient[0].numel()):
                columns[name, k].grad = gradient.view(len(gradient), -1)[:, k]
        for group in adam.param_groups:
            name, column = group["column"]
            group["lr"] = learning_rate(name, column, config, CELL_M) * decay(name, iteration, config)
        optimiser.step(iteration)
        adam.step()
        with torch.no_grad():
            for name, (low, high) in bounds.items():
                theirs[name].clamp_(low, high)
        for name in SHAPES:
            assert mine[name].grad is None
            found = mine[name].log() if name == "optical_depth" else mine[name]
            assert torch.allclose(found, theirs[name], rtol=1e-5, atol=1e-6), (name, iteration)
    for (name, k), tensor in columns.items():
        for moment in ("exp_avg", "exp_avg_sq"):
            found, expected = optimiser.state()[f"{name}/{moment}"], adam.state[tensor][moment]
            found = found.view(len(found), -1)[:, k]
            assert float((found - expected).norm() / expected.norm()) < 3e-6


def test_no_step_leaves_the_positive_numbers(how: str) -> None:
    config = preset("default")
    wild = replace(config, rates=replace(config.rates, log_scales=1e4))
    parameters = {"scales": torch.full((5, 3), 0.1, requires_grad=True)}
    bounds = {"scales": (torch.tensor(0.01), torch.tensor(0.5))}
    optimiser = Optimiser(parameters, bounds, wild, CELL_M)
    for sign, end in ((1.0, 0.01), (-1.0, 0.5)):
        for _ in range(20):
            parameters["scales"].grad = torch.full((5, 3), sign)
            optimiser.step(0)
        assert bool((parameters["scales"] == end).all())


@pytest.fixture(params=[*AVAILABLE, "plain"])
def how(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The engine with each instruction set that this processor has, and without it."""
    adam = cpu.adam
    if request.param == "plain":
        monkeypatch.setattr(fused, "takes", lambda tensors: False)
    else:
        monkeypatch.setattr(fused.cpu, "adam", lambda *arguments: adam(*arguments, instruction_set=request.param))
    return request.param


def test_values_changed_behind_a_backward_pass_are_noticed(how: str) -> None:
    parameters = {"means": torch.ones(4, 3, requires_grad=True)}
    optimiser = Optimiser(parameters, {}, preset("default"), CELL_M)
    square = (parameters["means"] ** 2).sum()
    parameters["means"].grad = torch.ones(4, 3)
    optimiser.step(0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        square.backward()


def test_every_parameter_needs_a_gradient() -> None:
    optimiser = Optimiser({"means": torch.ones(4, 3, requires_grad=True)}, {}, preset("default"), CELL_M)
    with pytest.raises(ValueError, match="means has no gradient"):
        optimiser.step(0)


def test_threads_change_nothing() -> None:
    usual = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            parameters = leaves()
            optimiser = Optimiser(parameters, BOUNDS, preset("default"), CELL_M)
            for iteration in range(3):
                for tensor in parameters.values():
                    tensor.grad = tensor.detach().sin()
                optimiser.step(iteration)
            found.append(parameters)
    finally:
        torch.set_num_threads(usual)
    for parameters in found[1:]:
        for name in SHAPES:
            assert torch.equal(parameters[name], found[0][name])


def test_state_comes_back(how: str) -> None:
    def trained(optimiser: Optimiser, parameters: dict[str, torch.Tensor], first: int, last: int) -> None:
        for iteration in range(first, last):
            for tensor in parameters.values():
                tensor.grad = torch.full_like(tensor, math.sin(iteration))
            optimiser.step(iteration)

    config = preset("default")
    whole, part = leaves(), leaves()
    trained(Optimiser(whole, BOUNDS, config, CELL_M), whole, 0, 6)
    first = Optimiser(part, BOUNDS, config, CELL_M)
    trained(first, part, 0, 3)
    second = Optimiser(part, BOUNDS, config, CELL_M)
    second.load_state(first.state())
    trained(second, part, 3, 6)
    for name in SHAPES:
        assert torch.equal(whole[name], part[name])


def test_tables_of_more_columns_than_the_engine_steps_are_left_to_plain_torch() -> None:
    assert fused.takes([torch.zeros(5, 16), torch.zeros(40), torch.zeros(2, 40, 48)])
    assert not fused.takes([torch.zeros(5, 3), torch.zeros(5, 48)])
