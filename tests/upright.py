"""Gaussians for tests: unturned, at given places."""

import numpy as np
import torch
from torch import Tensor

from sarsplat.gaussians import Gaussians, Harmonics, Scattering


def upright(
    means: np.ndarray | Tensor | list,
    scales: float | list | Tensor = 1.0,
    depth: float | list | Tensor = 1.0,
    law: Scattering | float | np.ndarray | Tensor = 1.0,
) -> Gaussians:
    """At places [N, 3], m, float32; other values of each, or of all, and coefficients of harmonics or another law."""
    places = torch.as_tensor(means, dtype=torch.float32).reshape(-1, 3)
    n = len(places)
    sizes, depths = (torch.as_tensor(values, dtype=torch.float32) for values in (scales, depth))
    if not isinstance(law, Scattering):
        coefficients = torch.as_tensor(law, dtype=torch.float32)
        law = Harmonics(coefficients.expand(n, 1).clone() if coefficients.ndim == 0 else coefficients)
    turns = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    return Gaussians(places, turns, sizes.expand(n, 3).clone(), depths.expand(n).clone(), law)
