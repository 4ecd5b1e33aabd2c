"""Checkpoints: tensors and a JSON state (in the metadata) in one safetensors file, so that one rename completes it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from sarsplat.data.files import decode_json, encode_json, open_file, write_bytes
from sarsplat.errors import SarsplatError, shown

_SCHEMA = "sarsplat-checkpoint"
_VERSION = "1"


def save_checkpoint(path: Path, tensors: Mapping[str, Tensor], state: dict[str, Any]) -> None:
    """Write a checkpoint (`.safetensors`), whole or not at all; an existing one is replaced.

    Tensors of any shape, dtype and device are exact; `state` is everything else, as JSON: counters, generator states,
    configuration. Raise SarsplatError if it is not JSON or holds NaN, or the file cannot be written.
    """
    path = Path(path)
    metadata = {"schema": _SCHEMA, "version": _VERSION, "state": encode_json(state, path).decode()}
    stored, addresses = dict[str, Tensor](), set[int]()
    for name, tensor in tensors.items():
        plain = tensor.detach().cpu().contiguous()
        if (address := plain.untyped_storage().data_ptr()) in addresses:
            plain = plain.clone()  # safetensors rejects tensors that share memory, such as views of one parameter
        addresses.add(address)
        stored[name] = plain
    write_bytes(path, safetensors.torch.save(stored, metadata=metadata))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors, on the CPU with the same bits, and the JSON state of a checkpoint.

    Raise SarsplatError if the file is missing, damaged, truncated, not a sarsplat checkpoint, or of another version.
    """
    path = Path(path)
    try:
        with open_file(path), safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is not a dict)
    except safetensors.SafetensorError as error:
        raise SarsplatError(
            f"{path} is a damaged checkpoint ({shown(str(error))}); delete it, and `sarsplat reconstruct … --resume` "
            "continues from the one before"
        ) from error
    if (metadata.get("schema"), metadata.get("version")) != (_SCHEMA, _VERSION):
        raise SarsplatError(
            f"{path} holds {shown(metadata.get('schema'))} of version {shown(metadata.get('version'))}, not "
            f"{_SCHEMA!r} of version {_VERSION!r}; give a file from RUN/checkpoints, or start the run again"
        )
    return tensors, decode_json(metadata.get("state", "").encode(), Path(f"the state in {path}"), dict[str, Any])
