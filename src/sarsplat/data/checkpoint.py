"""The whole state of a run in one safetensors file: tensors, and beside them a JSON state in the metadata.

One file, so that one rename makes it whole: a checkpoint is either there or not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from sarsplat.data.files import encode_json, plain_os_errors, write_bytes
from sarsplat.errors import SarsplatError

_SCHEMA = "sarsplat-checkpoint"
_VERSION = "1"


def save_checkpoint(path: Path, tensors: Mapping[str, Tensor], state: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all; an existing one is replaced.

    Parameters
    ----------
    path : Path
        File to write (`.safetensors`).
    tensors : mapping of str to Tensor
        Any shapes, dtypes and devices; exact.
    state : dict
        Everything else, as JSON: counters, generator states, configuration.

    Raises
    ------
    SarsplatError
        If the state is not JSON or holds NaN, or the file cannot be written.
    """
    path = Path(path)
    metadata = {"schema": _SCHEMA, "version": _VERSION, "state": encode_json(state, path).decode()}
    # Cloned because safetensors refuses tensors that share memory, such as views of one parameter.
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    write_bytes(path, safetensors.torch.save(plain, metadata=metadata))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a checkpoint.

    Returns
    -------
    tensors : dict of str to Tensor
        On the CPU, bit for bit as saved.
    state : dict
        The JSON state.

    Raises
    ------
    SarsplatError
        If the file is missing, damaged, truncated, no checkpoint of ours, or of another version.
    """
    path = Path(path)
    try:
        with plain_os_errors("read", path):
            path.open("rb").close()  # the OSErrors of safetensors do not say which one they are
        with plain_os_errors("read", path), safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dict)
    except safetensors.SafetensorError as error:
        raise SarsplatError(f"{path} is a damaged checkpoint ({error}); resume from another one") from error
    if metadata.get("schema") != _SCHEMA:
        raise SarsplatError(f"{path} holds tensors but is not a checkpoint of a run; give one from RUN/checkpoints")
    if metadata.get("version") != _VERSION:
        raise SarsplatError(
            f"{path} is a checkpoint of version {metadata.get('version')!r} but this program reads {_VERSION!r}; "
            "start the run again"
        )
    try:
        return tensors, dict(json.loads(metadata.get("state", "")))
    except (ValueError, TypeError, RecursionError) as error:
        raise SarsplatError(f"{path} has a garbled state ({error}); resume from another checkpoint") from error
