"""All that a training is after some iterations, in one file: what goes on from it needs nothing else but the images."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import msgspec
import torch
from torch import Tensor

from sarsplat.data import load_checkpoint, save_checkpoint
from sarsplat.errors import SarsplatError, counted, shown
from sarsplat.gaussians.initialise import Region
from sarsplat.geometry import ImageGrid, View
from sarsplat.reconstruction.config import Config, Surroundings
from sarsplat.reconstruction.model import SceneModel, Setting
from sarsplat.reconstruction.texture import Texture

# What files may say of a training: far more than any does, and what sums and pictures of them can bear.
_Count = Annotated[int, msgspec.Meta(ge=0, le=10**9)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e10)]
_Power = Annotated[float, msgspec.Meta(gt=0, le=1e18)]

AZIMUTH_OFFSETS = "azimuth/offset_deg"
"""Float64 [K], of the training views against their labels, degrees; there if any azimuth is uncertain."""

_REGION = ("normals", "offsets", "low", "high")


@dataclass(frozen=True)
class Snapshot:
    """A training's state, and what its results are made with.

    Parameters
    ----------
    iteration : int
        Steps done.
    seconds : float
        Time they took, s of wall clock.
    queue : tuple of int
        Training views that come next.
    grid : ImageGrid
        Of the images.
    views : tuple of View
        Of the training images, as the training has refined them.
    unit : float
        Power that counts as 1 in the model.
    brightest : float
        Largest β⁰ of the training images, linear power.
    tensors : dict of str to Tensor
        `model/…`, `optimiser/…`, `region/…` and whatever else the training needs, on the CPU.
    """

    iteration: int
    seconds: float
    queue: tuple[int, ...]
    grid: ImageGrid
    views: tuple[View, ...]
    unit: float
    brightest: float
    tensors: dict[str, Tensor]

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The tensors whose names begin with this and a slash, without it."""
        return {name.removeprefix(f"{prefix}/"): t for name, t in self.tensors.items() if name.startswith(f"{prefix}/")}

    def model(self, config: Config, device: torch.device | str = "cpu") -> SceneModel:
        """The learned scene, on a device.

        Raises
        ------
        ValueError, KeyError, TypeError, IndexError, RuntimeError, SarsplatError
            If the tensors are not those of a model with this configuration.
        """
        setting = Setting.seen(self._region, self.unit, self.views, self.grid)
        learned = self.part("model")
        model = SceneModel(config, setting, learned, device)
        if config.surroundings:
            self._check_chips(config.surroundings, learned)
            if texture := self.part("texture"):
                on_device = {name: tensor.to(device) for name, tensor in texture.items()}
                model.texture = Texture(on_device, self.grid, config.surroundings)
        model.scene(config.harmonics_degree)  # shapes and values are checked where they are used
        return model

    def _check_chips(self, surroundings: Surroundings, parameters: dict[str, Tensor]) -> None:
        """What renders chips besides Gaussians, which are checked where they are used."""
        views = len(self.views)
        expected = {"noise": (1,), "shift": (views, 2), "log_gain": (views,)}
        if surroundings.side_lobes:
            expected["log_side_lobes"] = (2,)
        for name, shape in expected.items():
            tensor = parameters[name]
            if tensor.dtype != torch.float32 or tensor.shape != shape or not tensor.isfinite().all():
                raise ValueError(f"{name} is {tensor.dtype} {list(tensor.shape)}, or not finite")
        if (ratio := self.tensors.get("texture/ratio")) is not None and len(ratio) != views:
            raise ValueError(f"a texture of {len(ratio)} chips for {counted(views, 'view')}")

    @cached_property
    def _region(self) -> Region:
        arrays = [self.tensors[f"region/{name}"].numpy() for name in _REGION]
        if arrays[0].shape != (len(arrays[1]), 3) or arrays[2].shape != (3,) or arrays[3].shape != (3,):
            raise ValueError(f"a region of {[array.shape for array in arrays]}")
        return Region(*arrays)

    def save(self, path: Path) -> None:
        """Write it as one safetensors file, whole or not at all."""
        state = {
            "iteration": self.iteration,
            "seconds": round(self.seconds, 3),
            "queue": self.queue,
            "grid": asdict(self.grid),
            "views": [asdict(view) for view in self.views],
            "unit": self.unit,
            "brightest": self.brightest,
        }
        save_checkpoint(path, self.tensors, state)

    @classmethod
    def load(cls, path: Path) -> Snapshot:
        """Read one back.

        Raises
        ------
        SarsplatError
            If the file is missing, damaged, or not of a training.
        """
        tensors, state = load_checkpoint(path)
        try:
            known = msgspec.convert(state, _State)
            return cls(
                known.iteration,
                known.seconds,
                known.queue,
                known.grid,
                known.views,
                known.unit,
                known.brightest,
                tensors,
            )
        except (msgspec.ValidationError, SarsplatError) as error:
            raise SarsplatError(
                f"{path} does not record how far the training had got ({shown(str(error))}); "
                "reconstruct it again with --overwrite"
            ) from error


class _State(msgspec.Struct, forbid_unknown_fields=True):
    """The JSON beside the tensors."""

    iteration: _Count
    seconds: _Seconds
    queue: tuple[_Count, ...]
    grid: ImageGrid
    views: tuple[View, ...]
    unit: _Power
    brightest: _Power


def region_tensors(region: Region) -> dict[str, Tensor]:
    """A region as a snapshot keeps it."""
    return {f"region/{name}": torch.from_numpy(getattr(region, name)) for name in _REGION}
