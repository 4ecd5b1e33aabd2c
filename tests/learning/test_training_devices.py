"""Training away from the CPU: nothing of a step leaves the device, and the CUDA engine's source learns as the CPU's."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from emulated_cuda import Emulator, render_on
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from made_runs import trained
from sarsplat import Config, Dataset, Ground, ImageGrid, Rendering, Run, SarsplatError, View, preset, reconstruct
from sarsplat.gaussians import Gaussians
from sarsplat.learning import Trainer, losses, model, optimiser
from sarsplat.learning.parts.target import dropped, share_dropped
from sarsplat.renderer.engines import cuda
from sarsplat.runs import Step
from sarsplat.settings.sections import Densification, Relocation
from sarsplat.surface import extract_points

DENSITY = Densification(4, 100, 4, gradient=1e-4, split_above=0.16, min_scattering=0.01, max_gaussians=300)


def small(**changes: Any) -> Config:
    return replace(preset("default"), iterations=50, gaussians=80, harmonics_every=10, views_per_step=2, **changes)


CONFIGS = {
    "amplitude": small(),
    "ssim": small(ssim_weight=0.2),
    "density": small(densification=DENSITY),
    "measured": replace(preset("measured"), iterations=50, gaussians=100, harmonics_every=2, views_per_step=2),
}


def render_nothing(
    gaussians: Gaussians,
    views: list[View],
    grid: ImageGrid,
    *,
    shift: Tensor | None = None,
    gain: Tensor | None = None,
    ground: Ground | None = None,
    **_: Any,
) -> Rendering:
    """As far as shapes, devices and autograd are concerned, a renderer for the device that has no memory."""
    count, device = (len(views), len(gaussians)), gaussians.means.device
    level: Any = sum(tensor.sum() for tensor in gaussians.tensors().values())
    if ground is not None:
        level = level + ground.gamma0.sum() + ground.exponent.sum()
    images = level.expand(len(views), 1, grid.rows, grid.columns)
    if shift is not None and gain is not None:
        images = images * gain[:, None, None, None] + shift.sum(1)[:, None, None, None]
    lit_area = torch.ones(count, device=device)
    return Rendering(images, lit_area[..., None], lit_area, plane_gradients=torch.ones(*count, 4, device=device))


class Crossings(TorchDispatchMode):
    """Operations between the CPU and the device: on a GPU each is a copy, one way or the other."""

    def __init__(self) -> None:
        super().__init__()
        self.counted: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), keywords: Any = None) -> Any:
        outcome = function(*arguments, **(keywords or {}))
        tensors = [leaf for leaf in tree_leaves((arguments, keywords, outcome)) if isinstance(leaf, Tensor)]
        if len({tensor.device.type for tensor in tensors}) > 1:
            self.counted.append(str(function))
        return outcome


@pytest.mark.parametrize("name", CONFIGS)
def test_a_step_copies_nothing_to_or_from_it(name: str, dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """On "meta", whose tensors hold nothing, any look at a number is an error."""
    monkeypatch.setattr(model, "render", render_nothing)
    config = replace(CONFIGS[name], relocation=Relocation(rounds=0))
    trainer = Trainer(dataset, config, device="meta")
    trainer.restore(trained(dataset, config, 1).snapshot(0.0))  # another device's
    trainer.step()  # which copies what stays there
    with Crossings() as crossings:
        assert trainer.step().device.type == "meta"
        assert crossings.counted == []
        torch.ones(3, device="cpu").to("meta")
        assert len(crossings.counted) == 1
    assert {tensor.device.type for tensor in trainer.model.parameters.values()} == {"meta"}


def test_what_is_dropped_is_a_share_by_chance() -> None:
    """Another one each step and for each seed, whatever the device; no two rows are dropped together."""
    cpu, count = torch.device("cpu"), 20_000
    steps = torch.stack([dropped(count, 0.25, 0, step, cpu) for step in range(1, 101)])
    assert float(steps.float().mean()) == pytest.approx(0.25, abs=1e-3)
    for over in (0, 1):
        spread = steps.float().mean(over).std()
        assert float(spread) == pytest.approx(np.sqrt(0.25 * 0.75 / steps.shape[over]), rel=0.2)
    centred = steps.float() - 0.25
    for other in (centred.roll(1, 0), centred.roll(1, 1), centred.roll((1, 1), (0, 1))):
        assert abs(float((centred * other).mean())) < 1e-3
    again = dropped(count, 0.25, 0, 7, cpu)
    assert torch.equal(again, steps[6])
    assert not torch.equal(again, dropped(count, 0.25, 1, 7, cpu))
    assert dropped(count, 0.25, 0, 7, torch.device("meta")).device.type == "meta"


def test_fewer_views_leave_more_out() -> None:
    usual = replace(preset("default"), dropout=0.1, few_views=6.0)
    assert [share_dropped(usual, views) for views in (1, 9, 12, 24, 1000)] == pytest.approx([0.4, 0.4, 0.25, 0.1, 0.1])
    assert share_dropped(replace(usual, dropout=0.6), 9) == 0.6
    assert share_dropped(replace(usual, dropout=0.0, few_views=0.0), 1) == 0.0


@pytest.mark.parametrize("name", CONFIGS)
def test_every_tensor_is_made_on_the_trainings_device(name: str, dataset: Dataset) -> None:
    """Also by density control and between trainings: whatever is made without naming one lands on the default device,
    and meets a tensor that lies elsewhere.
    """

    def resumed() -> tuple[Trainer, np.ndarray]:
        trainer = trained(dataset, CONFIGS[name], 5, device="cpu")
        trainer.restore(trainer.snapshot(0.0))
        for _ in range(5):
            trainer.step()
        return trainer, extract_points(trainer.gaussians, trainer.views[:2], trainer.grid, CONFIGS[name].points)

    usual, points = resumed()
    with torch.device("meta"):
        actual, found_points = resumed()
    for key, tensor in usual.model.parameters.items():
        assert torch.equal(actual.model.parameters[key], tensor), key
    assert np.array_equal(found_points, points)


def test_devices_that_are_none_are_refused(dataset: Dataset) -> None:
    for device in ("x", "mps"):
        with pytest.raises(SarsplatError, match=f"device '{device}' is unknown, or nothing is trained there"):
            Trainer(dataset, CONFIGS["amplitude"], device=device)
    with pytest.raises(SarsplatError, match="Gaussians cannot be turned to 'x'"):
        Trainer(dataset, CONFIGS["amplitude"]).gaussians.to("x")


def use_emulated(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train as on a GPU, whose kernels are emulated."""
    emulator = Emulator(library)
    monkeypatch.setattr(model, "render", partial(render_on, emulator))
    for module in (losses, optimiser):
        monkeypatch.setattr(module, "passes_for", lambda *_: partial(cuda.Pass, emulator))


def train(dataset: Dataset, config: Config, steps: int) -> tuple[Tensor, Trainer]:
    """The loss of every step."""
    trainer = Trainer(dataset, config)
    return torch.stack([trainer.step() for _ in range(steps)]), trainer


@pytest.mark.parametrize(("name", "steps"), [("amplitude", 24), ("ssim", 10), ("density", 10), ("measured", 10)])
def test_cuda_learns_as_the_cpu(
    name: str, steps: int, dataset: Dataset, library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its kernels are emulated; SSIM and likelihoods are plain torch."""
    dataset = replace(dataset, power=4 * dataset.power)  # at which no footprint ends within rounding of a pixel
    expected, usual = train(dataset, CONFIGS[name], steps)
    use_emulated(library, monkeypatch)
    actual, other = train(dataset, CONFIGS[name], steps)
    # nats have no zero of their own, and cross it: what counts is how far they have come
    far = 1e-3 * float(expected.max() - expected.min()) if name == "measured" else 0.0
    assert torch.allclose(actual, expected, rtol=1e-3, atol=far)
    assert len(other.model) == len(usual.model)
    if name == "density":
        assert len(usual.model) != 80
    if name == "amplitude":
        assert float(actual[-5:].mean()) < 0.8 * float(actual[:5].mean())


@pytest.mark.parametrize("name", CONFIGS)
def test_a_cuda_step_looks_at_no_number(
    name: str, dataset: Dataset, library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU each look is a wait for the device; the model's bounds say what would have to be asked."""
    looks = []

    def counted(method: str) -> Callable[..., Any]:
        usual = getattr(Tensor, method)

        def look(self: Tensor, *arguments: Any) -> Any:
            looks.append(method)
            return usual(self, *arguments)

        return look

    use_emulated(library, monkeypatch)
    trainer = Trainer(dataset, CONFIGS[name])
    trainer.step()  # which draws the order of the views, on the CPU
    for method in ("tolist", "item", "numpy", "cpu", "nonzero", "__bool__", "__float__", "__int__", "__index__"):
        monkeypatch.setattr(Tensor, method, counted(method))
    trainer.step()
    assert looks == []
    trainer.check()
    assert looks == ["__int__"]


def test_what_goes_wrong_is_told_and_not_saved(
    dataset: Dataset, library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_emulated(library, monkeypatch)

    def move_out(step: Step) -> None:
        if step.iteration == 3:
            step.trainer.model.parameters["means"].data[5, 0] = 500.0

    # what is logged every step is told at once
    with pytest.raises(SarsplatError, match="a Gaussian has left its bounds"):
        reconstruct(dataset, replace(small(), checkpoint_every=2), tmp_path / "run", on_step=move_out, quiet=True)
    assert Run.load(tmp_path / "run").iteration == 2
