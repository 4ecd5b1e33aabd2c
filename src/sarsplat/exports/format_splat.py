"""`.splat`: Gaussians for the web viewer antimatter15/splat, 32 bytes each without header.

Position and standard deviations (six float32, m), colour and opacity (RGBA, uint8), and the quaternion wxyz as
uint8, 128 + 128·q. A colour cannot depend on the direction: it is the mean over all directions above the horizon.
The viewer shows the first ones first while it loads, so the largest and densest come first.
"""

from __future__ import annotations

import numpy as np

from sarsplat.data import write_bytes
from sarsplat.data.ply import SPLAT
from sarsplat.data.viewer_colours import viewer_colours
from sarsplat.exports.format import Format
from sarsplat.gaussians import Gaussians
from sarsplat.names import Colour


def splat_bytes(gaussians: Gaussians, colour: Colour) -> bytes:
    """Return the Gaussians as bytes of a `.splat` file."""
    values = {name: tensor.detach().double().cpu().numpy() for name, tensor in gaussians.tensors().items()}
    opacity = -np.expm1(-values["optical_depth"])
    rgba = np.column_stack([viewer_colours(gaussians, colour).mean, opacity])
    quaternions = values["quaternions"] / np.linalg.norm(values["quaternions"], axis=1, keepdims=True)
    table = np.empty(len(gaussians), SPLAT)
    table["position"], table["scale"] = values["means"], values["scales"]
    table["rgba"] = np.round(255 * rgba)
    table["rotation"] = np.clip(np.round(128 + 128 * quaternions), 0, 255)
    importance = values["scales"].prod(axis=1) * opacity
    return table[np.argsort(-importance, kind="stable")].tobytes()


FORMAT = Format(
    writers={"gaussians": lambda gaussians, path, colour: write_bytes(path, splat_bytes(gaussians, colour))},
    opened_with={"gaussians": "a web viewer of .splat files"},
    recognises=lambda _, size: size % SPLAT.itemsize == 0,  # it has no signature
)
