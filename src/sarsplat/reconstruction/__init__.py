"""From SAR images to Gaussians and a point cloud. What needs torch is loaded when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.methods import METHODS
from sarsplat.reconstruction.presets import PRESETS, preset

if TYPE_CHECKING:
    from sarsplat.reconstruction.loop import Step
    from sarsplat.reconstruction.method import Inputs, Method, Reconstruction
    from sarsplat.reconstruction.points import extract_points
    from sarsplat.reconstruction.run import Run
    from sarsplat.reconstruction.tensorboard import TensorBoard
    from sarsplat.reconstruction.trainer import Trainer
    from sarsplat.reconstruction.training import reconstruct

_MODULE_OF = {
    "extract_points": "points",
    "Inputs": "method",
    "Method": "method",
    "Reconstruction": "method",
    "Run": "run",
    "Step": "loop",
    "TensorBoard": "tensorboard",
    "Trainer": "trainer",
    "reconstruct": "training",
}

__all__ = [
    "METHODS",
    "PRESETS",
    "Config",
    "Inputs",
    "Method",
    "Reconstruction",
    "Run",
    "Step",
    "TensorBoard",
    "Trainer",
    "extract_points",
    "preset",
    "reconstruct",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
