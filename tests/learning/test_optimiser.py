"""The engines' Adam and the one in plain torch against torch's own, step for step."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from emulated_cuda import Emulator

from sarsplat import Dataset, preset
from sarsplat.learning import Trainer, optimiser
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.parts.part import Learned
from sarsplat.renderer.engines import cpu, cuda

AVAILABLE = cpu.instruction_sets()
# more than one task, a tail in the last vector, one to sixteen columns
SHAPES = {"means": (6001, 3), "quaternions": (7, 4), "optical_depth": (1,), "scattering": (333, 16)}
ITERATIONS = 900
LEARNED = {
    "means": Learned(
        (None, 3),
        (0.02,),
        decay=lambda done: 0.05**done,
        low=torch.tensor([-1.0, -0.5, 0.0]),
        high=torch.tensor([1.0, 0.5, 2.0]),
    ),
    "quaternions": Learned((7, 4), (0.02,)),
    "optical_depth": Learned((1,), (0.05,), low=0.99, high=1.01, logarithmic=True),
    "scattering": Learned((None, 16), (0.08, *[0.02] * 15)),
}


def leaves() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    leaves = {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}
    leaves["optical_depth"].fill_(1.0)
    return {name: tensor.requires_grad_() for name, tensor in leaves.items()}


def test_a_gradient_that_is_not_a_number_does_not_become_a_bound(how: str) -> None:
    mine = leaves()
    optimiser, bounded = Optimiser(mine, LEARNED, ITERATIONS), ("means", "optical_depth")
    for name, tensor in mine.items():
        tensor.grad = torch.full_like(tensor, math.nan if name in bounded else 0.0)
    optimiser.step(0)
    assert all(mine[name].isnan().all() for name in bounded)  # the next rendering says so


def test_every_step_is_torchs(how: str) -> None:
    mine = leaves()
    optimiser = Optimiser(mine, LEARNED, ITERATIONS)
    theirs = {name: tensor.detach().clone() for name, tensor in mine.items()}
    theirs["optical_depth"].log_()  # what is stepped is its logarithm
    bounds = {"means": (LEARNED["means"].low, LEARNED["means"].high), "optical_depth": (math.log(0.99), math.log(1.01))}
    columns = {  # one to a group of torch's: each has its rate
        (name, k): tensor.view(len(tensor), -1)[:, k].requires_grad_()
        for name, tensor in theirs.items()
        for k in range(tensor[0].numel())
    }
    groups = [{"params": [tensor], "column": key} for key, tensor in columns.items()]
    torchs = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15)
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
        for group in torchs.param_groups:
            name, column = group["column"]
            rates = LEARNED[name].rates
            group["lr"] = rates[column if len(rates) > 1 else 0] * LEARNED[name].decay(iteration / ITERATIONS)
        optimiser.step(iteration)
        torchs.step()
        with torch.no_grad():
            for name, (low, high) in bounds.items():
                theirs[name].clamp_(low, high)
        for name in SHAPES:
            assert mine[name].grad is None
            actual = mine[name].log() if name == "optical_depth" else mine[name]
            assert torch.allclose(actual, theirs[name], rtol=1e-5, atol=1e-6), (name, iteration)
    for (name, k), tensor in columns.items():
        for moment in ("exp_avg", "exp_avg_sq"):
            actual, expected = optimiser.state[name][moment], torchs.state[tensor][moment]
            actual = actual.view(len(actual), -1)[:, k]
            assert float((actual - expected).norm() / expected.norm()) < 3e-6


def test_no_step_leaves_the_positive_numbers(how: str) -> None:
    parameters = {"scales": torch.full((5, 3), 0.1, requires_grad=True)}
    wild = {"scales": Learned((None, 3), (1e4,), low=0.01, high=0.5, logarithmic=True)}
    optimiser = Optimiser(parameters, wild, ITERATIONS)
    for sign, end in ((1.0, 0.01), (-1.0, 0.5)):
        for _ in range(20):
            parameters["scales"].grad = torch.full((5, 3), sign)
            optimiser.step(0)
        assert bool((parameters["scales"] == end).all())


@pytest.fixture(params=[*AVAILABLE, "cuda", "plain"])
def how(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The CPU engine with each instruction set that this processor has, the CUDA engine emulated, and neither."""
    if request.param == "plain":
        new_pass = None
    elif request.param == "cuda":
        new_pass = partial(cuda.Pass, Emulator(request.getfixturevalue("library")))
    else:
        new_pass = partial(cpu.Pass, request.param)
    monkeypatch.setattr(optimiser, "passes_for", lambda *_: new_pass)
    return request.param


def test_values_changed_behind_a_backward_pass_are_noticed(how: str) -> None:
    parameters = {"means": torch.ones(4, 3, requires_grad=True)}
    optimiser = Optimiser(parameters, LEARNED, ITERATIONS)
    square = (parameters["means"] ** 2).sum()
    parameters["means"].grad = torch.ones(4, 3)
    optimiser.step(0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        square.backward()


def test_every_parameter_needs_a_gradient() -> None:
    optimiser = Optimiser({"means": torch.ones(4, 3, requires_grad=True)}, LEARNED, ITERATIONS)
    with pytest.raises(ValueError, match="means has no gradient"):
        optimiser.step(0)


def test_threads_change_nothing(threads) -> None:
    actual = []
    for count in (1, 2, 3):
        threads(count)
        parameters = leaves()
        optimiser = Optimiser(parameters, LEARNED, ITERATIONS)
        for iteration in range(3):
            for tensor in parameters.values():
                tensor.grad = tensor.detach().sin()
            optimiser.step(iteration)
        actual.append(parameters)
    for parameters in actual[1:]:
        for name in SHAPES:
            assert torch.equal(parameters[name], actual[0][name])


def test_state_comes_back(how: str) -> None:
    def trained(optimiser: Optimiser, parameters: dict[str, torch.Tensor], first: int, last: int) -> None:
        for iteration in range(first, last):
            for tensor in parameters.values():
                tensor.grad = torch.full_like(tensor, math.sin(iteration))
            optimiser.step(iteration)

    whole, part = leaves(), leaves()
    trained(Optimiser(whole, LEARNED, ITERATIONS), whole, 0, 6)
    first = Optimiser(part, LEARNED, ITERATIONS)
    trained(first, part, 0, 3)
    second = Optimiser(part, LEARNED, ITERATIONS)
    second.load(first.tensors())
    trained(second, part, 3, 6)
    for name in SHAPES:
        assert torch.equal(whole[name], part[name])


def test_tables_of_more_columns_than_the_engine_steps_are_left_to_plain_torch() -> None:
    for new_pass in (cpu.Pass, partial(cuda.Pass, None)):
        assert new_pass().has("adam", {"columns": 16})
        assert not new_pass().has("adam", {"columns": 48})
    waves = {"scattering": torch.ones(5, 48, requires_grad=True)}
    optimiser = Optimiser(waves, {"scattering": Learned((None, 48), (0.1,))}, ITERATIONS)
    waves["scattering"].grad = torch.ones(5, 48)
    optimiser.step(0)
    assert torch.allclose(waves["scattering"], torch.tensor(0.9))  # every column was stepped


@pytest.mark.parametrize("preset_name", ["default", "paper", "measured"])
def test_rates_are_those_of_the_configuration(preset_name: str, dataset: Dataset) -> None:
    config = replace(preset(preset_name), gaussians=20)
    trainer = Trainer(dataset, config)
    learned, rates, cell_m = trainer.model.learned, config.rates, dataset.grid.cell_m
    expected = {"means": cell_m * rates.means, "scales": rates.log_scales, "scattering": rates.scattering}
    if config.surroundings:
        expected |= {"shift": cell_m * rates.shift, "noise": rates.nuisance, "ground_texture": rates.ground}
    assert trainer.learning_rates.items() >= expected.items()
    assert learned["scattering"].rates[1:] == (rates.directional_scattering,) * (len(learned["scattering"].rates) - 1)
    late = trainer.optimiser.rates(config.iterations)
    assert late["means"] == pytest.approx(cell_m * rates.means_end)
    assert late["quaternions"] == pytest.approx(0.1 * rates.quaternions)
    assert trainer.optimiser.rates(config.iterations // 2)["quaternions"] == rates.quaternions
