"""From SAR images to Gaussians and a point cloud."""

from sarsplat.reconstruction.config import PRESETS, Config, preset
from sarsplat.reconstruction.points import extract_points
from sarsplat.reconstruction.reconstruct import Step, reconstruct
from sarsplat.reconstruction.run import Run
from sarsplat.reconstruction.trainer import Trainer

__all__ = ["PRESETS", "Config", "Run", "Step", "Trainer", "extract_points", "preset", "reconstruct"]
