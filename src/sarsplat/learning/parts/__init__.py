"""Parts of the scene model, such as target, ground and noise: classes in the files of this folder."""

import torch

from sarsplat.learning.parts.part import Part
from sarsplat.learning.scene_frame import SceneFrame
from sarsplat.plugins import classes_in
from sarsplat.settings.config import Config


def parts_of(config: Config, frame: SceneFrame, device: torch.device) -> list[Part]:
    """Parts of a configuration's model, in the order in which they make a scene and its images."""
    kinds = classes_in(__name__, Part)
    return [kind(config, frame, device) for kind in kinds if kind.wanted(config)]
