"""LPIPS v0.1 on AlexNet features, in plain torch.

Source: Zhang, Isola, Efros, Shechtman, Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric",
2018.
"""

import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32

from sarsplat.errors import SarsplatError
from sarsplat.evaluation.images import Stack, UndefinedScore, normalised_amplitude

WEIGHTS_VARIABLE = "SARSPLAT_LPIPS_WEIGHTS"
_FEATURES, _HEADS = "alexnet_features_torchvision.npz", "lpips_v0.1_lin_alex.pth"
# AlexNet up to its fifth convolution: (index in torchvision's `features`, stride, padding, max-pooled before)
_LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))
_UNUSABLE = (
    *(OSError, EOFError, KeyError, TypeError, ValueError, RuntimeError, AttributeError),
    *(pickle.UnpicklingError, zipfile.BadZipFile),
)
_SMALLEST_IMAGE = 31  # pixels; below, the second pooling window no longer fits


class Lpips:
    """Perceptual distance of image pairs.

    Parameters
    ----------
    weights_dir : pathlib.Path
        Folder with `alexnet_features_torchvision.npz` (the five convolutions, torchvision's key names) and
        `lpips_v0.1_lin_alex.pth` (the linear heads). Neither file is unpickled freely.

    Raises
    ------
    SarsplatError
        If a file is missing or does not hold these weights.
    """

    def __init__(self, weights_dir: Path) -> None:
        try:
            with np.load(weights_dir / _FEATURES, allow_pickle=False) as arrays:
                self._convolutions = [
                    tuple(torch.from_numpy(arrays[f"features.{index}.{part}"]) for part in ("weight", "bias"))
                    for index, *_ in _LAYERS
                ]
            heads = torch.load(weights_dir / _HEADS, map_location="cpu", weights_only=True)
            self._heads = [heads[f"lin{layer}.model.1.weight"] for layer in range(len(_LAYERS))]
            for (weight, _), head in zip(self._convolutions, self._heads, strict=True):
                head.reshape(1, len(weight), 1, 1)
        except _UNUSABLE as error:
            raise SarsplatError(
                f"{weights_dir} holds no usable LPIPS weights ({type(error).__name__}: {str(error).splitlines()[0]}); "
                f"it must contain {_FEATURES} and {_HEADS}"
            ) from error

    @torch.no_grad()
    def __call__(
        self, first: Float32[torch.Tensor, "v 3 rows columns"], second: Float32[torch.Tensor, "v 3 rows columns"]
    ) -> Float32[torch.Tensor, " v"]:
        """Distance of each pair of colour images with values in [−1, 1], at least 31 pixels on a side."""
        if min(first.shape[2:]) < _SMALLEST_IMAGE:
            raise UndefinedScore(
                f"LPIPS needs images of at least {_SMALLEST_IMAGE} × {_SMALLEST_IMAGE} pixels, "
                f"not {first.shape[2]} × {first.shape[3]}; use larger ones"
            )
        pairs = zip(self._features(first), self._features(second), self._heads, strict=True)
        return torch.stack([F.conv2d((a - b) ** 2, head).mean(dim=(1, 2, 3)) for a, b, head in pairs]).sum(dim=0)

    def _features(self, image: Float32[torch.Tensor, "v 3 rows columns"]) -> list[Float32[torch.Tensor, "v _ _ _"]]:
        """Output of each of the five rectified convolutions, channels scaled to unit length."""
        # the mean and deviation of ImageNet, moved from [0, 1] to [−1, 1]
        mean, deviation = image.new_tensor([[-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]])[:, None, :, None, None]
        x, features = (image - mean) / deviation, []
        for (weight, bias), (_, stride, padding, pooled) in zip(self._convolutions, _LAYERS, strict=True):
            x = F.max_pool2d(x, kernel_size=3, stride=2) if pooled else x
            x = F.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))
            features.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return features


def lpips(truth: Stack, rendered: Stack, reference_amplitude: float, network: Lpips) -> float:
    """Mean LPIPS of a set: amplitude / reference_amplitude moved from [0, 1] to [−1, 1], grey three times, no clip.

    Parameters
    ----------
    truth, rendered : numpy.ndarray, float [V, rows, columns]
        β⁰, linear power.
    reference_amplitude : float
        The largest amplitude √β⁰ of the *training* set.
    network : Lpips
        The loaded weights.
    """
    grey = (normalised_amplitude(power, reference_amplitude) * 2 - 1 for power in (truth, rendered))
    first, second = (torch.from_numpy(image)[:, None].expand(-1, 3, -1, -1) for image in grey)
    scores = [network(a, b) for a, b in zip(first.split(16), second.split(16), strict=True)]
    return float(torch.cat(scores).mean())


def lpips_weights(given: Path | None) -> Path | None:
    """Folder of the LPIPS weights: the one given, else the environment variable SARSPLAT_LPIPS_WEIGHTS, else None."""
    named = os.environ.get(WEIGHTS_VARIABLE)
    return given if given is not None else Path(named) if named else None
