"""Polarimetric covariance of a part of the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Complex128

from sarsplat.data.header import Box
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import Gaussians, Polarimetric
from sarsplat.gaussians.law_polarimetric import covariances_between
from sarsplat.geometry import ImageGrid, RayGrid, View
from sarsplat.renderer.steps import attenuate, project


def covariance_within(
    gaussians: Gaussians, views: Sequence[View], grid: ImageGrid, rays: RayGrid, box: Box
) -> Complex128[np.ndarray, "p p"]:
    """E[y yᴴ] of the Gaussians whose centres lie in a box, on average over views: see `Run.covariance_within`."""
    law = gaussians.scattering
    if not isinstance(law, Polarimetric):
        raise SarsplatError(
            f"this run's scattering is {law.kind}, which is the same in all polarisations; give one that was learned "
            "from stacks of several (preset polarimetric)"
        )
    if not all(low <= high for low, high in zip(*box, strict=True)):  # also catches NaN
        raise SarsplatError(f"the box is {box[0]} to {box[1]} m; give its lower corner (x, y, z) first")
    corners = [torch.tensor(corner).to(gaussians.means) for corner in box]
    inside = ((gaussians.means >= corners[0]) & (gaussians.means <= corners[1])).all(dim=1)
    if not bool(inside.any()):
        raise SarsplatError(
            f"no Gaussian lies in the box {box[0]} to {box[1]} m; give lower and upper corners around some"
        )
    count = len(law.polarisations)
    total = np.zeros((count, count), np.complex128)
    with torch.no_grad():
        for view in views:  # one at a time: scenes may be large
            projection = project(gaussians, [view], grid, rays=rays)
            lit_area = attenuate(projection, rays).lit_area[0, inside]
            lit = (projection.amplitudes[0, inside] * lit_area[:, None]).double().sum(0)
            total += covariances_between(lit, count).cpu().numpy()
    return total / len(views)
