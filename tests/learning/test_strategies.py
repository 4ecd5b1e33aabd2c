"""A strategy of one's own: it changes rows, remembers what it likes, and is saved and resumed like ours."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from made_runs import assert_same, trained
from sarsplat import Dataset, SarsplatError, preset, reconstruct
from sarsplat.learning import Trainer
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.parts.part import Learned
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies import Info, State, Strategy, ops
from sarsplat.settings.sections import Densification

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_strategy.py"
CONFIG = replace(
    preset("default"),
    iterations=40,
    gaussians=300,
    harmonics_every=10,
    densification=Densification(start=5, every=10, gradient=1e-5, max_gaussians=600),
)


class Restless(Strategy):
    """Removes what has been dim for long, and now and then makes two of the brightest."""

    def initial_state(self, params: dict[str, Tensor]) -> State:
        count = len(params["means"])
        return State(rows={"dim": torch.zeros(count)}, whole={"changes": torch.zeros(2, dtype=torch.int64)})

    def wants_plane_gradients(self, step: int) -> bool:
        return step % 2 == 0

    def step_pre_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        assert (info.rendering.plane_gradients is not None) == (step % 2 == 0 or step <= CONFIG.densification.stop)
        assert params["means"].grad is None

    def step_post_backward(
        self, params: dict[str, Tensor], optimizers: Optimiser, state: State, step: int, info: Info
    ) -> None:
        sigma = info.rendering.cross_sections[..., 0].mean(0)
        state.rows["dim"] += (sigma < sigma.median()).float()
        if step % 7 == 0:
            gone = state.rows["dim"] > 4
            state.whole["changes"][0] += gone.sum()
            ops.remove(params, optimizers, state, gone)
            brightest = params["scattering"].detach()[:, 0].topk(3).indices
            which = torch.zeros(len(params["means"]), dtype=torch.bool).index_fill(0, brightest, True)
            ops.split(params, optimizers, state, which, info.generator)
            state.whole["changes"][1] += 3


def restless(dataset: Dataset, steps: int, snapshot: Snapshot | None = None) -> Snapshot:
    return trained(dataset, CONFIG, steps, snapshot, strategies=[Restless()]).snapshot(0.0)


@pytest.mark.parametrize("stop", [13, 14, 20])
def test_it_goes_on_as_if_it_had_never_stopped(dataset: Dataset, tmp_path: Path, stop: int) -> None:
    whole = restless(dataset, 30)
    assert whole.tensors["strategy/Restless/changes"].min() > 10
    restless(dataset, stop).save(tmp_path / "stopped.safetensors")
    assert_same(whole, restless(dataset, 30 - stop, Snapshot.load(tmp_path / "stopped.safetensors")))
    per_gaussian = ("model/means", "strategy/Restless/dim", "strategy/density/gradient", "strategy/density/seen")
    assert len({len(whole.tensors[name]) for name in per_gaussian}) == 1


def test_a_training_goes_on_only_with_the_strategies_it_was_begun_with(dataset: Dataset) -> None:
    snapshot = restless(dataset, 1)
    with pytest.raises(
        SarsplatError,
        match="begun with the strategies Restless, density, growth, relocation, smoothing, not density, growth, ",
    ):
        Trainer(dataset, CONFIG).restore(snapshot)
    damaged = replace(snapshot, tensors=snapshot.tensors | {"strategy/Restless/dim": torch.zeros(3)})
    with pytest.raises(ValueError, match="dim is torch"):
        restless(dataset, 0, damaged)


def test_names_are_their_own_and_parameters_are_checked(dataset: Dataset) -> None:
    class Choosy(Restless):
        name = "choosy"

        def check(self, params: dict[str, Tensor]) -> None:
            raise SarsplatError("there is no colour; give one")

    with pytest.raises(SarsplatError, match="2 strategies are called 'Restless'; give each"):
        Trainer(dataset, CONFIG, strategies=[Restless(), Restless()])
    with pytest.raises(SarsplatError, match="there is no colour"):
        Trainer(dataset, CONFIG, strategies=[Choosy()])


def test_the_example_keeps_few_gaussians(dataset: Dataset) -> None:
    strategy = runpy.run_path(str(EXAMPLE))["KeepBrightest"](every=5, count=100)
    run = reconstruct(dataset, replace(CONFIG, densification=None, iterations=8), strategies=[strategy], quiet=True)
    assert len(run.gaussians) == 100


# ---- rows of any dictionary of parameters ---------------------------------------------------------------------------
def begun() -> tuple[dict[str, Tensor], Optimiser, State]:
    """Three Gaussians with a colour, and what has none of theirs, after a step."""
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3, 3), "quaternions": (3, 4), "scales": (3, 3), "optical_depth": (3,), "colour": (3, 2)}
    params = {name: torch.rand(shape, generator=generator).add(0.5) for name, shape in shapes.items()}
    params = {name: tensor.requires_grad_() for name, tensor in {**params, "noise": torch.ones(1)}.items()}
    learned = {name: Learned((None, *shape[1:]), (0.01,)) for name, shape in shapes.items()}
    optimizers = Optimiser(params, {**learned, "noise": Learned((1,), (0.1,))}, 100)
    for tensor in params.values():
        tensor.grad = torch.rand(tensor.shape, generator=generator)
    optimizers.step(0)
    return params, optimizers, State({"age": torch.tensor([1.0, 2.0, 3.0])}, {"rounds": torch.ones(3)})


WHICH = torch.tensor([False, True, False])
OPERATIONS: dict[str, tuple[Callable[..., Tensor], list[int], list[bool]]] = {
    "remove": (lambda *a: ops.remove(*a, gone=WHICH), [0, 2], [True, True]),
    "duplicate": (lambda *a: ops.duplicate(*a, which=WHICH), [0, 1, 2, 1], [True, True, True, False]),
    "split": (
        lambda *a: ops.split(*a, which=WHICH, generator=torch.Generator()),
        [0, 2, 1, 1],
        [True, True, False, False],
    ),
    "relocate": (
        lambda *a: ops.relocate(*a, idle=torch.tensor([0]), strong=torch.tensor([1]), generator=torch.Generator()),
        [1, 1, 2],
        [False, False, True],
    ),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_a_row_operation_takes_everything_along(name: str) -> None:
    operate, expected, kept = OPERATIONS[name]
    before, old, _ = begun()
    params, optimizers, state = begun()
    noise, source, stays = params["noise"], operate(params, optimizers, state), torch.tensor(kept)
    assert source.tolist() == expected
    assert state.rows["age"].tolist() == [age + 1 if stay else 0 for age, stay in zip(expected, kept, strict=True)]
    assert state.whole["rounds"].tolist() == [1, 1, 1]
    assert params["noise"] is noise
    assert torch.equal(params["colour"], before["colour"][source])
    for key in ("means", "scales", "optical_depth"):
        assert torch.equal(params[key][stays], before[key][source][stays])
    moments, earlier = optimizers.state["colour"]["exp_avg"], old.state["colour"]["exp_avg"]
    assert torch.equal(moments, torch.where(stays[:, None], earlier[source], 0.0))
    moved = (params["means"] - before["means"][source]).norm(dim=1) > 0
    assert moved.tolist() == [not stay and name in ("split", "relocate") for stay in kept]
    halved = 0.6 if name == "relocate" else 1.0
    assert torch.equal(params["optical_depth"], before["optical_depth"][source] * torch.where(stays, 1.0, halved))
    shrunk = 1 / 1.6 if name == "split" else 1.0
    assert torch.equal(params["scales"], before["scales"][source] * torch.where(stays, 1.0, shrunk)[:, None])
    moves = optimizers.take_moves()
    assert moves is not None
    assert moves.tolist() == [row if stay else -1 for row, stay in zip(expected, kept, strict=True)]
    assert optimizers.take_moves() is None
    for tensor in params.values():
        assert tensor.is_leaf
        tensor.grad = torch.ones_like(tensor)
    optimizers.step(1)


def test_moves_of_one_turn_add_up() -> None:
    params, optimizers, state = begun()
    ops.duplicate(params, optimizers, state, WHICH)  # 0 1 2 1'
    ops.remove(params, optimizers, state, torch.tensor([True, False, False, False]))
    moves = optimizers.take_moves()
    assert moves is not None
    assert moves.tolist() == [1, 2, -1]
