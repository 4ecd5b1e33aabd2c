"""Losses of single images. Images are β⁰, linear power; amplitude is its root."""

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

Images = Float[Tensor, "v rows columns"]

Loss = Callable[[Tensor, Tensor], Tensor]
"""Function of rendered and true images, float32 [V, rows, columns], β⁰ in linear power; returns one number."""

FLOOR = 1e-3
"""Amplitude below which the square root is smoothed, relative to the reference: its slope is infinite at 0."""

SPECKLE_FLOOR = 1e-4
"""Power added before the logarithm without `Surroundings`, relative to the brightest pixel."""

SSIM_WINDOW = 11
SSIM_STD = 1.5
C1, C2 = 0.01**2, 0.03**2

_OFFSETS = torch.arange(SSIM_WINDOW, dtype=torch.float64, device="cpu") - SSIM_WINDOW // 2
_WINDOW = torch.softmax(-(_OFFSETS**2) / (2 * SSIM_STD**2), dim=0)
_WEIGHTS = tuple(_WINDOW.tolist())


def amplitude_loss(power: Images, truth: Images, reference: float, ssim_weight: float) -> Float[Tensor, ""]:
    """(1 − λ)·L1 + λ·(1 − SSIM) on amplitude, √(power / reference² + ε²) − ε; differentiable with respect to `power`.

    `reference` is the amplitude that counts as 1, λ the `ssim_weight`. SSIM has a Gaussian window of 11 × 11, σ = 1.5,
    at pixels where it fits whole; smaller images raise. float32 uses the device's engine if it has this loss.
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

    def plain(self, power: Images, truth: Images) -> Float[Tensor, ""]:
        rendered = (power / self.reference**2 + FLOOR**2).sqrt() - FLOOR
        true = truth.sqrt() / self.reference
        absolute = _means((rendered - true).abs()).mean(0)
        if self.ssim_weight == 0:
            return absolute
        return (1 - self.ssim_weight) * absolute + self.ssim_weight * (1 - structural_similarity(rendered, true))

    def numbers(self, power: Tensor, truth: Tensor) -> dict[str, Any]:
        sizes = dict(zip(("views", "rows", "columns"), power.shape, strict=True))
        similarity = {"window": _WEIGHTS, "ssim_weight": self.ssim_weight, "c1": C1, "c2": C2}
        return {**sizes, **similarity, "reference": self.reference, "floor": FLOOR}

    def outputs(self, power: Tensor, truth: Tensor) -> dict[str, Tensor]:
        return {"loss": power.new_empty(())}


def structural_similarity(a: Images, b: Images) -> Float[Tensor, ""]:
    """Mean SSIM of images in [0, 1], over pixels where the window fits whole."""
    mean_a, mean_b, aa, bb, ab = (_blurred(maps) for maps in (a, b, a * a, b * b, a * b))
    var_a, var_b, cov = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + C1) * (2 * cov + C2)
    return _means(similarity / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))).mean(0)


def _blurred(images: Images) -> Float[Tensor, "v fewer_rows fewer_columns"]:
    """Convolve with the window, by matrix products: a GPU's convolutions would round to TF32."""
    rows, columns = (_window_matrix(size, images.dtype, images.device) for size in images.shape[1:])
    return rows.T @ (images @ columns)


@kept_on_device(maxsize=16)
def _window_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "{size} {size-10}"]:
    """Convolution with the window as a matrix."""
    matrix = torch.zeros(size, size - SSIM_WINDOW + 1, dtype=torch.float64, device="cpu")
    for k, weight in enumerate(_WINDOW.tolist()):
        matrix.diagonal(-k).fill_(weight)
    return matrix.to(device, dtype)


def speckle_loss(power: Images, intensity: Images) -> Float[Tensor, ""]:
    """Negative log-likelihood of single-look speckle, nats per pixel: the mean of log S + I / S.

    S is the rendered β⁰ with its noise floor, > 0, and I the measured one.
    """
    return speckle_nats(power, intensity).mean(0)


def speckle_nats(power: Images, intensity: Images) -> Float[Tensor, " v"]:
    """`speckle_loss` of each image."""
    return _means(power.log() + intensity / power)


def total_power_loss(power: Images, intensity: Images) -> Float[Tensor, ""]:
    """Mean over images of (difference / mean)² of the total powers, in which speckle nearly averages out; at most 4."""
    rendered, true = _means(power), _means(intensity)
    mean = ((rendered + true) / 2).clamp(min=torch.finfo(power.dtype).tiny)
    return (((rendered - true) / mean) ** 2).mean(0)


def _means(images: Images) -> Float[Tensor, " v"]:
    """Mean of each image, dimension by dimension: the bits of a sum to one number would depend on torch's threads."""
    return images.mean(2).mean(1)


def _amplitude(config: Config, brightest: float, unit: float) -> Loss:
    reference = math.sqrt(brightest)
    return lambda rendered, truth: amplitude_loss(rendered, truth, reference, config.ssim_weight)


def _speckle(config: Config, brightest: float, unit: float) -> Loss:
    if config.surroundings:  # the model has a noise floor
        floor = config.surroundings.speckle_floor
        return lambda rendered, truth: speckle_loss(rendered / unit + floor, truth / unit + floor)

    def loss(rendered: Tensor, truth: Tensor) -> Tensor:
        power, intensity, weight = rendered / brightest, truth / brightest, config.total_power
        likelihood = speckle_loss(power + SPECKLE_FLOOR, intensity + SPECKLE_FLOOR)
        return likelihood + weight * total_power_loss(power, intensity) if weight else likelihood

    return loss


@dataclass(frozen=True)
class NamedLoss:
    """A loss that configurations can name, with its title and unit for reports."""

    make: Callable[[Config, float, float], Loss] | None
    """Function that makes the loss as `named_loss` does; None for that of stacks, in `observations/stacks.py`."""
    title: str
    unit: str
    """Unit; likelihoods begin with `nats`."""


LOSSES = {
    "amplitude": NamedLoss(_amplitude, "difference of amplitudes (largest = 1)", "loss"),
    "speckle": NamedLoss(_speckle, "negative log-likelihood of the speckle", "nats per pixel"),
    "passes": NamedLoss(None, "negative log-likelihood of all passes", "nats per pixel"),
}
"""Losses by their names in configurations."""


def named_loss(config: Config, brightest: float, unit: float) -> Loss:
    """Return the loss that a configuration names; raise if it is unknown or for stacks.

    `brightest` is the largest β⁰ of the training images, `unit` the power that counts as 1 in the model.
    """
    if config.loss not in LOSSES:
        raise SarsplatError(f"loss {shown(config.loss)} is unknown; {advised(config.loss, LOSSES)}")
    if (make := LOSSES[config.loss].make) is None:
        raise SarsplatError(
            f"the loss {config.loss} needs passes on, which is off; switch passes on, or choose the loss "
            f"{' or '.join(name for name, loss in LOSSES.items() if loss.make)}"
        )
    return make(config, brightest, unit)
