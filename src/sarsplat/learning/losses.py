"""What training minimises. Images are β⁰, linear power; amplitude is its root.

To add a loss, write a function that makes it from the configuration and the images' scale, and name it in `LOSSES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sarsplat.errors import SarsplatError, advised, shown
from sarsplat.renderer.engines.choice import passes_for
from sarsplat.renderer.engines.on_device import kept_on_device
from sarsplat.renderer.engines.operation import Operation
from sarsplat.settings.config import Config

Loss = Callable[[Tensor, Tensor], Tensor]
"""Of rendered and true images, float32 [V, rows, columns], β⁰ in linear power; one number."""


FLOOR = 1e-3
"""Amplitudes are softened below this share of the reference: the root has no slope at zero."""

SPECKLE_FLOOR = 1e-4
"""Power, of the brightest, that is added to images of nothing but a target: the logarithm has no value at zero."""

SSIM_WINDOW = 11
SSIM_STD = 1.5
C1, C2 = 0.01**2, 0.03**2

_OFFSETS = torch.arange(SSIM_WINDOW, dtype=torch.float64, device="cpu") - SSIM_WINDOW // 2
_WINDOW = torch.softmax(-(_OFFSETS**2) / (2 * SSIM_STD**2), dim=0)
_WEIGHTS = tuple(_WINDOW.tolist())


def amplitude_loss(
    power: Float[Tensor, "v rows columns"],
    truth: Float[Tensor, "v rows columns"],
    reference: float,
    ssim_weight: float,
) -> Float[Tensor, ""]:
    """(1 − λ)·L1 + λ·(1 − SSIM) on amplitude, √(power / reference² + ε²) − ε; differentiable with respect to `power`.

    Rendered and true β⁰ are of one dtype and on one device; float32 is one call of the device's engine where that has
    it, anything else plain torch. `reference` is the amplitude that counts as 1, λ the `ssim_weight`. SSIM has a
    Gaussian window of 11 × 11, σ = 1.5, and counts where the window fits whole; smaller images are refused.
    """
    if truth.shape != power.shape or truth.dtype != power.dtype or truth.device != power.device:
        raise SarsplatError(
            f"truth is {truth.dtype} {tuple(truth.shape)} on {truth.device}; it must be {power.dtype} "
            f"{tuple(power.shape)} on {power.device}, as the power that it is compared with"
        )
    if ssim_weight > 0 and min(power.shape[1:]) < SSIM_WINDOW:
        raise SarsplatError(
            f"SSIM needs images of at least {SSIM_WINDOW} × {SSIM_WINDOW} pixels, and these have "
            f"{power.shape[1]} × {power.shape[2]}; use larger ones or a preset without SSIM"
        )
    new_pass = passes_for("auto", {"power": power, "truth": truth})
    return AmplitudeLoss(reference, ssim_weight).on(new_pass, power, truth)


class AmplitudeLoss(Operation):
    """`amplitude_loss`: on engines, value and gradient in one go; differentiable with respect to `power`."""

    operation = "amplitude_loss"
    names = ("power", "truth")
    at_once = True

    def __init__(self, reference: float, ssim_weight: float) -> None:
        self.reference, self.ssim_weight = reference, ssim_weight

    def plain(
        self, power: Float[Tensor, "v rows columns"], truth: Float[Tensor, "v rows columns"]
    ) -> Float[Tensor, ""]:
        rendered = (power / self.reference**2 + FLOOR**2).sqrt() - FLOOR
        true = truth.sqrt() / self.reference
        absolute = _mean((rendered - true).abs())
        if self.ssim_weight == 0:
            return absolute
        return (1 - self.ssim_weight) * absolute + self.ssim_weight * (1 - structural_similarity(rendered, true))

    def numbers(self, power: Tensor, truth: Tensor) -> dict[str, Any]:
        sizes = dict(zip(("views", "rows", "columns"), power.shape, strict=True))
        similarity = {"window": _WEIGHTS, "ssim_weight": self.ssim_weight, "c1": C1, "c2": C2}
        return {**sizes, **similarity, "reference": self.reference, "floor": FLOOR}

    def outputs(self, power: Tensor, truth: Tensor) -> dict[str, Tensor]:
        return {"loss": power.new_empty(())}


def structural_similarity(a: Float[Tensor, "v rows columns"], b: Float[Tensor, "v rows columns"]) -> Float[Tensor, ""]:
    """Mean SSIM of images in [0, 1] where the window fits whole."""
    mean_a, mean_b, aa, bb, ab = (_blurred(maps) for maps in (a, b, a * a, b * b, a * b))
    var_a, var_b, cov = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + C1) * (2 * cov + C2)
    return _mean(similarity / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2)))


def _blurred(images: Float[Tensor, "v rows columns"]) -> Float[Tensor, "v fewer_rows fewer_columns"]:
    """Seen through the window. Matrix products, because a GPU's convolutions would round to TF32."""
    rows, columns = (_window_matrix(size, images.dtype, images.device) for size in images.shape[1:])
    return rows.T @ (images @ columns)


@kept_on_device(maxsize=16)
def _window_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "{size} {size-10}"]:
    """A window in every column, each one further down."""
    matrix = torch.zeros(size, size - SSIM_WINDOW + 1, dtype=torch.float64, device="cpu")
    for k, weight in enumerate(_WINDOW.tolist()):
        matrix.diagonal(-k).fill_(weight)
    return matrix.to(device, dtype)


def speckle_loss(
    power: Float[Tensor, "v rows columns"], intensity: Float[Tensor, "v rows columns"]
) -> Float[Tensor, ""]:
    """Negative log-likelihood of single-look speckle, nats per pixel: the mean of log S + I / S.

    S is the rendered β⁰ with its noise floor, > 0, and I the measured one.
    """
    return speckle_nats(power, intensity).mean(0)


def speckle_nats(
    power: Float[Tensor, "v rows columns"], intensity: Float[Tensor, "v rows columns"]
) -> Float[Tensor, " v"]:
    """`speckle_loss` of each image."""
    return _means(power.log() + intensity / power)


def total_power_loss(
    power: Float[Tensor, "v rows columns"], intensity: Float[Tensor, "v rows columns"]
) -> Float[Tensor, ""]:
    """How far total powers are apart, (difference / mean)² averaged over images: of all pixels speckle is nearly gone.

    Near equality that is the square of the logarithm of their ratio; it is at most 4.
    """
    rendered, true = _means(power), _means(intensity)
    mean = ((rendered + true) / 2).clamp(min=torch.finfo(power.dtype).tiny)
    return (((rendered - true) / mean) ** 2).mean(0)


def _mean(images: Float[Tensor, "v rows columns"]) -> Float[Tensor, ""]:
    return _means(images).mean(0)


def _means(images: Float[Tensor, "v rows columns"]) -> Float[Tensor, " v"]:
    """One dimension after the other: torch splits a sum to one number by threads, and its bits would depend on them."""
    return images.mean(2).mean(1)


@dataclass(frozen=True)
class ImageScale:
    """How bright the training images are, in linear power."""

    brightest: float
    """Largest β⁰."""
    unit: float
    """Power that counts as 1 in the model: their mean where the ground shows, else 1."""


def _amplitude(config: Config, scale: ImageScale) -> Loss:
    reference = math.sqrt(scale.brightest)
    return lambda rendered, truth: amplitude_loss(rendered, truth, reference, config.ssim_weight)


def _speckle(config: Config, scale: ImageScale) -> Loss:
    if config.surroundings:  # with a noise floor of their own
        return lambda rendered, truth: speckle_loss(rendered / scale.unit, truth / scale.unit)
    unit, weight = scale.brightest, config.total_power

    def loss(rendered: Tensor, truth: Tensor) -> Tensor:
        power, intensity = rendered / unit, truth / unit
        likelihood = speckle_loss(power + SPECKLE_FLOOR, intensity + SPECKLE_FLOOR)
        return likelihood + weight * total_power_loss(power, intensity) if weight else likelihood

    return loss


@dataclass(frozen=True)
class NamedLoss:
    """A loss that configurations can name: what makes it, and how reports call it and its unit."""

    make: Callable[[Config, ImageScale], Loss] | None
    """None if it compares something else than images, which is compared by what observes it."""
    title: str
    unit: str
    """That of a likelihood begins with `nats`."""


LOSSES = {
    "amplitude": NamedLoss(_amplitude, "difference of amplitudes (largest = 1)", "loss"),
    "speckle": NamedLoss(_speckle, "negative log-likelihood of the speckle", "nats per pixel"),
    "passes": NamedLoss(None, "negative log-likelihood of all passes", "nats per pixel"),
}
"""Losses by their names in configurations."""


def named_loss(config: Config, scale: ImageScale) -> Loss:
    """The loss that a configuration names; a SarsplatError if there is none."""
    if config.loss not in LOSSES:
        raise SarsplatError(f"loss {shown(config.loss)} is unknown; {advised(config.loss, LOSSES)}")
    if (make := LOSSES[config.loss].make) is None:
        raise SarsplatError(
            f"the loss {config.loss} is learned from stacks with passes on, and passes is off; switch it on, or choose "
            f"the loss {' or '.join(name for name, loss in LOSSES.items() if loss.make)}"
        )
    return make(config, scale)
