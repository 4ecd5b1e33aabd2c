"""Learning with the second bounce by way of the ground: what reflects is found, and runs keep it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datasets import dataset_of
from sarsplat import Config, Dataset, Ground, Run, Trainer, preset, reconstruct
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, NormalLobes
from sarsplat.geometry import ImageGrid, View
from sarsplat.renderer import GroundBounce, render
from sarsplat.settings.sections import Bounce, FlatGround

GRID = ImageGrid(40, 40, (0.3, 0.3), (0.3, 0.3))
VIEWS = [View(45.0 * k + 10.0, (20.0, 40.0, 60.0)[k % 3]) for k in range(8)]
SHORT = replace(
    preset("default"), iterations=150, gaussians=150, coarsest=1, ground=FlatGround(pitch=0.0), bounce=Bounce()
)
