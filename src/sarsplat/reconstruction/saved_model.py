"""The scene of Gaussians that a snapshot holds."""

from __future__ import annotations

import torch
from torch import Tensor

from sarsplat.gaussians.initialise import Region
from sarsplat.reconstruction.config import Config
from sarsplat.reconstruction.model import SceneModel
from sarsplat.reconstruction.setting import Setting
from sarsplat.reconstruction.snapshot import Snapshot

_REGION = ("normals", "offsets", "low", "high")


def saved_model(snapshot: Snapshot, config: Config, device: torch.device | str = "cpu") -> SceneModel:
    """The learned scene, on a device.

    Raises
    ------
    ValueError, KeyError, TypeError, IndexError, RuntimeError, SarsplatError
        If the tensors are not those of a model with this configuration.
    """
    setting = Setting(_region(snapshot), snapshot.unit, snapshot.views, snapshot.grid)
    learned, state = snapshot.part("model"), snapshot.part("part")
    model = SceneModel(config, setting, learned, device)
    others = [learned[name] for name, how in model.learned.items() if not how.per_gaussian]
    if not all(tensor.isfinite().all() for tensor in (*others, *state.values())):
        raise ValueError("numbers that are not finite")
    model.load({name: tensor.to(model.device) for name, tensor in state.items()})
    model.scene(config.harmonics_degree)  # the Gaussians' values are checked where they are used
    return model


def model_tensors(model: SceneModel) -> dict[str, Tensor]:
    """A model as a snapshot keeps it."""
    region = {f"region/{name}": torch.from_numpy(getattr(model.setting.region, name)) for name in _REGION}
    learned = {f"model/{name}": tensor.detach() for name, tensor in model.parameters.items()}
    return learned | {f"part/{name}": tensor for name, tensor in model.state().items()} | region


def _region(snapshot: Snapshot) -> Region:
    arrays = [snapshot.tensors[f"region/{name}"].numpy() for name in _REGION]
    if arrays[0].shape != (len(arrays[1]), 3) or arrays[2].shape != (3,) or arrays[3].shape != (3,):
        raise ValueError(f"a region of {[array.shape for array in arrays]}")
    return Region(*arrays)
