"""From SAR images to Gaussians and a point cloud."""

from sarsplat.reconstruct.config import PRESETS, Config, preset
from sarsplat.reconstruct.points import extract_points
from sarsplat.reconstruct.run import Run
from sarsplat.reconstruct.trainer import Trainer, reconstruct

__all__ = ["PRESETS", "Config", "Run", "Trainer", "extract_points", "preset", "reconstruct"]
