"""The scene of Gaussians that a snapshot holds."""

from __future__ import annotations

import torch
from torch import Tensor

from sarsplat.errors import counted
from sarsplat.gaussians.initialise import Region
from sarsplat.reconstruction.config import Config, Surroundings
from sarsplat.reconstruction.model import SceneModel, Setting
from sarsplat.reconstruction.snapshot import Snapshot
from sarsplat.reconstruction.texture import Texture

AZIMUTH_OFFSETS = "azimuth/offset_deg"
"""Float64 [K], of the training views against their labels, degrees; there if any azimuth is uncertain."""

_REGION = ("normals", "offsets", "low", "high")


def saved_model(snapshot: Snapshot, config: Config, device: torch.device | str = "cpu") -> SceneModel:
    """The learned scene, on a device.

    Raises
    ------
    ValueError, KeyError, TypeError, IndexError, RuntimeError, SarsplatError
        If the tensors are not those of a model with this configuration.
    """
    setting = Setting.seen(_region(snapshot), snapshot.unit, snapshot.views, snapshot.grid)
    learned = snapshot.part("model")
    model = SceneModel(config, setting, learned, device)
    if config.surroundings:
        _check_chips(snapshot, config.surroundings, learned)
        if texture := snapshot.part("texture"):
            on_device = {name: tensor.to(device) for name, tensor in texture.items()}
            model.texture = Texture(on_device, snapshot.grid, config.surroundings)
    model.scene(config.harmonics_degree)  # shapes and values are checked where they are used
    return model


def region_tensors(region: Region) -> dict[str, Tensor]:
    """A region as a snapshot keeps it."""
    return {f"region/{name}": torch.from_numpy(getattr(region, name)) for name in _REGION}


def _region(snapshot: Snapshot) -> Region:
    arrays = [snapshot.tensors[f"region/{name}"].numpy() for name in _REGION]
    if arrays[0].shape != (len(arrays[1]), 3) or arrays[2].shape != (3,) or arrays[3].shape != (3,):
        raise ValueError(f"a region of {[array.shape for array in arrays]}")
    return Region(*arrays)


def _check_chips(snapshot: Snapshot, surroundings: Surroundings, parameters: dict[str, Tensor]) -> None:
    """What renders chips besides Gaussians, which are checked where they are used."""
    views = len(snapshot.views)
    expected = {"noise": (1,), "shift": (views, 2), "log_gain": (views,)}
    if surroundings.side_lobes:
        expected["log_side_lobes"] = (2,)
    for name, shape in expected.items():
        tensor = parameters[name]
        if tensor.dtype != torch.float32 or tensor.shape != shape or not tensor.isfinite().all():
            raise ValueError(f"{name} is {tensor.dtype} {list(tensor.shape)}, or not finite")
    if (ratio := snapshot.tensors.get("texture/ratio")) is not None and len(ratio) != views:
        raise ValueError(f"a texture of {len(ratio)} chips for {counted(views, 'view')}")
