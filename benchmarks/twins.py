"""Loss and Adam, each one call of the engine on the CPU, against the torch that they replace."""

from __future__ import annotations

from typing import Any

import torch
from clock import in_turn, ratio, spread
from recipes import COUNT, halfway
from torch import Tensor

from sarsplat.learning.losses import AmplitudeLoss, amplitude_loss
from sarsplat.learning.optimiser import Optimiser
from sarsplat.settings.presets import preset

SSIM_WEIGHT = preset("paper").ssim_weight


def losses(views: int, ssim_weight: float) -> dict[str, Any]:
    """L1 with or without SSIM, and its gradient, the engine's and plain torch's."""
    generator = torch.Generator().manual_seed(2)
    power = (torch.rand(views, 128, 128, generator=generator) ** 2).requires_grad_()
    truth = torch.rand(views, 128, 128, generator=generator)

    def gradient(loss: Tensor) -> Tensor:
        return torch.autograd.grad(loss, power)[0]

    programs = {
        "torch": lambda: gradient(AmplitudeLoss(1.0, ssim_weight).plain(power, truth)),
        "engine": lambda: gradient(amplitude_loss(power, truth, 1.0, ssim_weight)),
    }
    theirs, mine = (program() for program in programs.values())
    if not float((mine - theirs).norm() / theirs.norm()) < 1e-4:
        raise SystemExit("the engine's loss is not plain torch's; the comparison is void")
    return programs


def adams(count: int) -> dict[str, Any]:
    """One step of every parameter, kept in its bounds; torch's Adam in its fused form, its fastest.

    The engine steps scales and optical depths by their logarithms on top of that.
    """
    model, other = halfway(count), halfway(count)
    gradients = {name: torch.randn_like(tensor) for name, tensor in model.parameters.items()}
    bounds = Optimiser(other.parameters, other.learned, preset("default").iterations)
    mine = Optimiser(model.parameters, model.learned, preset("default").iterations)
    theirs = torch.optim.Adam(list(other.parameters.values()), lr=1e-4, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def give(parameters: dict[str, Tensor]) -> None:
        for name, tensor in parameters.items():
            tensor.grad = gradients[name]

    def torch_step() -> None:
        give(other.parameters)
        theirs.step()
        bounds.constrain()

    def engine_step() -> None:
        give(model.parameters)
        mine.step(0)

    return {"torch": torch_step, "engine": engine_step}


def measure(quick: bool) -> dict[str, Any]:
    """Torch's time over the engine's."""
    count, many, repeats = (1000, 2, 3) if quick else (COUNT, 8, 20)
    contenders = {
        "L1 with gradient, one view": losses(1, 0.0),
        "L1 + SSIM with gradient, one view": losses(1, SSIM_WEIGHT),
        f"L1 + SSIM with gradient, {many} views": losses(many, SSIM_WEIGHT),
        f"Adam and bounds, {count:,} Gaussians": adams(count),
    }
    times = {name: in_turn(programs, repeats) for name, programs in contenders.items()}
    return {
        "ratios": {f"{name}: torch / engine": ratio(pair["torch"], pair["engine"]) for name, pair in times.items()},
        "times": {f"{name}: {who}": spread(samples) for name, pair in times.items() for who, samples in pair.items()},
    }
