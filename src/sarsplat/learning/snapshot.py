"""Complete state of a training, in one file; to resume, only the images are needed besides."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import torch
from torch import Tensor

from sarsplat.data import load_checkpoint, save_checkpoint
from sarsplat.data.header import GridHeader
from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry import ImageGrid, Stack, View
from sarsplat.threads import convert

# Bounds of numbers in files: far above real ones, and safe for sums and pictures.
_Count = Annotated[int, msgspec.Meta(ge=0, le=10**9)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e10)]
_Power = Annotated[float, msgspec.Meta(gt=0, le=1e18)]


@dataclass(frozen=True)
class Snapshot:
    """State of a training, and the views, grid and scale of its results."""

    iteration: int
    """Number of steps made."""
    seconds: float
    """Wall-clock time of these steps, s."""
    queue: tuple[int, ...]
    """Numbers of the next training views."""
    grid: ImageGrid
    views: tuple[View, ...]
    """Views of the training images, as refined by the training."""
    unit: float
    """Power that counts as 1 in the model."""
    brightest: float
    """Largest β⁰ of the training images, linear power."""
    stacks: tuple[Stack, ...] = field(kw_only=True, default=())
    """Stacks of the training images; empty if training uses power only."""
    tensors: dict[str, Tensor]
    """All tensors of the training by name (`model/…`, `optimiser/…`, …), on the CPU."""

    def part(self, prefix: str) -> dict[str, Tensor]:
        """Tensors whose names begin with `prefix/`, without that prefix."""
        return {name.removeprefix(f"{prefix}/"): t for name, t in self.tensors.items() if name.startswith(f"{prefix}/")}

    def digest(self) -> str:
        """Hash of the training's tensors, hexadecimal."""
        digest = hashlib.blake2b(digest_size=16)
        for name, tensor in sorted(self.tensors.items()):
            digest.update(name.encode())
            digest.update(tensor.contiguous().numpy().data)
        return digest.hexdigest()

    def like(self, prefix: str, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return `part(prefix)`; raise KeyError or ValueError unless names, shapes and types fit and all is finite."""
        saved = self.part(prefix)
        for name, like in expected.items():
            fitting(saved, name, like.dtype, like.shape)
        if saved.keys() != expected.keys() or not all(tensor.isfinite().all() for tensor in saved.values()):
            raise ValueError(f"{prefix} holds more than {', '.join(expected)}, or numbers that are not finite")
        return saved

    def save(self, path: Path) -> None:
        """Write it as one safetensors file, whole or not at all."""
        state = {
            "iteration": self.iteration,
            "seconds": round(self.seconds, 3),
            "queue": self.queue,
            "grid": self.grid.as_dict(),
            "views": [view.as_dict() for view in self.views],
            "stacks": [asdict(stack) for stack in self.stacks],
            "unit": self.unit,
            "brightest": self.brightest,
        }
        save_checkpoint(path, self.tensors, state)

    @classmethod
    def load(cls, path: Path) -> "Snapshot":
        """Read a snapshot; raise if the file is missing, damaged, or not of a training."""
        tensors, state = load_checkpoint(path)
        if "apart_deg" in str(state.get("views")):
            raise SarsplatError(
                f"{path} has bistatic views, which are not supported; open it with the version of its training"
            )
        try:
            fields = msgspec.structs.asdict(convert(state, _State))
            fields["grid"] = ImageGrid.of(**msgspec.structs.asdict(fields["grid"]))
            return cls(**fields, tensors=tensors)
        except (msgspec.ValidationError, SarsplatError) as error:
            raise SarsplatError(
                f"{path} does not record how far the training had got ({shown(str(error))}); "
                "reconstruct it again with overwrite=True"
            ) from error


def fitting(tensors: Mapping[str, Tensor], name: str, dtype: torch.dtype, shape: Sequence[int]) -> Tensor:
    """Return a tensor of a checkpoint; raise KeyError or ValueError unless it has this type and shape."""
    tensor = tensors[name]
    if tensor.dtype != dtype or tuple(tensor.shape) != tuple(shape):
        raise ValueError(f"{name} is {tensor.dtype} {list(tensor.shape)}, not {dtype} {list(shape)}")
    return tensor


class _State(msgspec.Struct, forbid_unknown_fields=True):
    """JSON metadata of the file."""

    iteration: _Count
    seconds: _Seconds
    queue: tuple[_Count, ...]
    grid: GridHeader
    views: tuple[View, ...]
    unit: _Power
    brightest: _Power
    stacks: tuple[Stack, ...] = ()
