"""A strategy of one's own: it changes rows, remembers what it likes, and is saved and resumed like ours."""

import runpy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from made import small_dataset, upright
from made_runs import assert_same, trained
from sarsplat import Dataset, Gaussians, ImageGrid, SarsplatError, Trainer, preset, reconstruct
from sarsplat.learning.optimiser import Optimiser
from sarsplat.learning.parts.part import Learned
from sarsplat.learning.snapshot import Snapshot
from sarsplat.learning.strategies import Info, State, Strategy, ops
from sarsplat.learning.strategies.density import DensityControl
from sarsplat.learning.strategies.growth import Relocating, pairs, shares_of_cubes
from sarsplat.learning.strategies.smoothing import Smoothed
from sarsplat.learning.strategies.strategy import Params
from sarsplat.learning.strategies.texture import TextureEstimation
from sarsplat.learning.strategies.views import AzimuthRefinement, TurnRefinement
from sarsplat.settings.sections import Densification, Relocation, Smoothing, Surroundings, Turns

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

    def initial_state(self, params: Params) -> State:
        count = len(params["means"])
        return State(rows={"dim": torch.zeros(count)}, whole={"changes": torch.zeros(2, dtype=torch.int64)})

    def wants_plane_gradients(self, step: int) -> bool:
        return step % 2 == 0

    def step_pre_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
        assert (info.rendering.plane_gradients is not None) == (step % 2 == 0 or step <= CONFIG.densification.stop)
        assert params["means"].grad is None

    def step_post_backward(self, params: Params, optimizers: Optimiser, state: State, step: int, info: Info) -> None:
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


@pytest.mark.parametrize("stop", [13, 20])
def test_it_goes_on_as_if_it_had_never_stopped(dataset: Dataset, tmp_path: Path, stop: int) -> None:
    whole = restless(dataset, 30)
    assert whole.tensors["strategy/Restless/changes"].min() > 10
    restless(dataset, stop).save(tmp_path / "stopped.safetensors")
    assert_same(whole, restless(dataset, 30 - stop, Snapshot.load(tmp_path / "stopped.safetensors")))
    rows = ("Restless/rows/dim", "density/rows/gradient", "density/rows/seen")
    per_gaussian = ("model/means", *(f"strategy/{name}" for name in rows))
    assert len({len(whole.tensors[name]) for name in per_gaussian}) == 1


def test_a_training_goes_on_only_with_the_strategies_it_was_begun_with(dataset: Dataset) -> None:
    snapshot = restless(dataset, 1)
    with pytest.raises(SarsplatError, match="begun with the strategies Restless, collective, density, growth"):
        Trainer(dataset, CONFIG).restore(snapshot)
    damaged = replace(snapshot, tensors=snapshot.tensors | {"strategy/Restless/rows/dim": torch.zeros(3)})
    with pytest.raises(ValueError, match="dim is torch"):
        restless(dataset, 0, damaged)


def test_names_are_their_own_and_parameters_are_checked(dataset: Dataset) -> None:
    class Choosy(Restless):
        name = "choosy"

        def check(self, params: Params) -> None:
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
def begun() -> tuple[Params, Optimiser, State]:
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
        lambda *a: ops.relocate(*a, idle=torch.tensor([0]), joined=torch.tensor([1]), generator=torch.Generator()),
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


# ---- density control: who is cloned, split and pruned ----------------------------------------------------------------
CONTROL = Densification(
    start=10, stop=100, every=10, gradient=1.0, split_above=0.1, max_extent=0.3, min_scattering=0.01, max_gaussians=10
)

GRID = ImageGrid(10, 8, (0.5, 1.0), (1.0, 1.0))  # cells of 1 m, 10 m in range


def five() -> Gaussians:
    """Steep and small, steep and large, flat, black, far too large."""
    scales = torch.tensor([[0.05], [0.2], [0.05], [0.05], [5.0]])
    return upright(torch.arange(15.0), scales, [1.0, 1.0, 1.0, 1e-4, 1.0])


def decided(*gradient: float, **changes: float) -> list[list[bool]]:
    """Who is pruned, cloned and split, by sums over two views."""
    state = State({"gradient": torch.tensor(gradient), "seen": torch.full((len(gradient),), 2.0)})
    density = DensityControl(replace(CONFIG, densification=replace(CONTROL, **changes)), small_dataset())
    return [mask.tolist() for mask in density.decide(five(), GRID, state)]


def test_small_ones_are_cloned_large_ones_split_and_dark_or_huge_ones_pruned() -> None:
    pruned, cloned, split = decided(4.0, 4.0, 1.0, 9.0, 9.0)
    assert pruned == [False, False, False, True, True]
    assert cloned == [True, False, False, False, False]
    assert split == [False, True, False, False, False]
    _, cloned, split = decided(8.0, 4.0, 6.0, 0.0, 0.0, max_gaussians=6)
    assert (cloned, split) == ([True, False, False, False, False], [False] * 5)  # room is given to the steepest
    with pytest.raises(SarsplatError, match=r"would remove all Gaussians: none scatters at least 1e\+06"):
        decided(0.0, 0.0, 0.0, 0.0, 0.0, min_scattering=1e6)


# ---- relocation: who moves, where to, and that little of the image changes -------------------------------------------
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_the_least_join_others_each_its_own() -> None:
    shares = torch.tensor([5.0, 0.0, 3.0, 0.01, 2.0, 0.5]).double()
    idle, joined = pairs(shares, 0.01, generator())
    assert idle.tolist() == [1, 3]  # 0.01 of 10.51 is less than a hundredth, 0.51 is more
    assert len(set(joined.tolist())) == 2
    assert not set(joined.tolist()) & {1, 3}


def test_at_most_half_is_idle_and_nobody_joins_what_is_not_lit() -> None:
    assert len(pairs(torch.ones(10).double(), 1.0, generator())[0]) == 5
    idle, joined = pairs(torch.tensor([0.0, 0.0, 0.0, 1.0]).double(), 0.5, generator())
    assert (len(idle), joined.tolist()) == (1, [3])
    assert len(pairs(torch.zeros(4).double(), 0.5, generator())[0]) == 0


def test_each_lit_cube_counts_alike_however_many_share_it() -> None:
    means = torch.tensor([[0.1, 0.1, 0.1]] * 4 + [[1.1, -2.0, 0.1]] + [[5.0, 5.0, 5.0]] * 2)
    shares = shares_of_cubes(torch.tensor([3.0, 1.0, 0.0, 0.0, 2.0, 1e-3, 1e-3]).double(), means, 1.0, 0.05)
    assert shares[:5].tolist() == [0.75, 0.25, 0.0, 0.0, 1.0]
    assert 0 < shares[5] == shares[6] < 0.05  # of a cube that is hardly lit
    assert shares_of_cubes(torch.zeros(2).double(), means[:2], 1.0, 0.05).tolist() == [0, 0]


def test_a_round_keeps_the_number_and_about_the_power(dataset: Dataset) -> None:
    config = replace(preset("default"), iterations=80, gaussians=400, relocation=Relocation(rounds=1))
    trainer = trained(dataset, config, 69)
    images, rendering = trainer.model.render(trainer.views, trainer.grid, 0)
    before, means = images.detach(), trainer.gaussians.means.clone()
    rows = pairs(rendering.lit_area.mean(0).double(), 0.01, generator())
    ops.relocate(trainer.model.parameters, trainer.optimiser, State(), *rows, generator())
    assert trainer.optimiser.take_moves() is not None
    after = trainer.model.render(trainer.views, trainer.grid, 0)[0].detach()
    assert len(trainer.model) == 400
    assert 5 < int((trainer.gaussians.means != means).any(dim=1).sum()) < 300
    assert float(after.mean()) == pytest.approx(float(before.mean()), rel=0.25)  # halves that hid each other are seen
    trainer.step()


# ---- rounds ----------------------------------------------------------------------------------------------------------
OFTEN = 100_000_000


@pytest.mark.parametrize(
    ("kind", "settings", "iterations", "expected"),
    [
        (DensityControl, CONTROL, 130, range(10, 100, 10)),
        (Relocating, Relocation(rounds=5, until=0.5), 100, range(10, 60, 10)),
        (Relocating, Relocation(until=0), 100, []),
        (Relocating, Relocation(rounds=OFTEN, until=1), 100, range(1, 101)),
        (Smoothed, Smoothing(rounds=4), 40, range(10, 50, 10)),
        (TextureEstimation, Surroundings(texture_rounds=4, texture_from=0.4), 600, range(240, 601, 90)),
        (TextureEstimation, Surroundings(texture_rounds=OFTEN, texture_from=0.5), 60, range(30, 61)),
        (AzimuthRefinement, Surroundings(azimuth_rounds=8), 700, range(210, 631, 60)),
        (AzimuthRefinement, Surroundings(azimuth_rounds=1), 600, [180]),
        (AzimuthRefinement, Surroundings(azimuth_rounds=0), 600, []),
        (AzimuthRefinement, Surroundings(azimuth_rounds=OFTEN), 60, range(18, 55)),
        (TurnRefinement, Turns(rounds=5, begin=0.1, until=0.9), 100, range(10, 91, 20)),
        (TurnRefinement, Turns(rounds=0), 100, []),
    ],
)
def test_rounds_are_evenly_spaced(kind: Any, settings: Any, iterations: int, expected: Sequence[int]) -> None:
    strategy = kind(replace(CONFIG, iterations=iterations, **{kind.section: settings}), small_dataset())
    assert [step for step in range(iterations + 1) if strategy.due(step)] == [*expected]
