"""Disk cache of compiled kernels and their check, in $XDG_CACHE_HOME/sarsplat or ~/.cache/sarsplat."""

from __future__ import annotations

import hashlib
import os
import warnings
from functools import cache
from pathlib import Path
from threading import get_ident

from sarsplat.errors import SarsplatWarning


def read(name: str) -> bytes | None:
    """Return cached content; None if it is missing or its checksum is wrong."""
    try:
        content = (_folder() / name).read_bytes()
    except OSError:
        return None
    digest, payload = content[:32], content[32:]
    return payload if hashlib.sha256(payload).digest() == digest else None


def write(name: str, content: bytes) -> None:
    """Cache content; warn once if the folder is not writable."""
    folder = _folder()
    temporary = folder / f"{name}.{os.getpid()}-{get_ident()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
        temporary.replace(folder / name)
    except OSError as error:
        _warn(folder, str(error))


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sarsplat"


@cache
def _warn(folder: Path, reason: str) -> None:
    warnings.warn(
        f"the compiled CUDA engine and its check cannot be kept in {folder} ({reason}), so that every program begins "
        "with them; make it writable, or name another folder in XDG_CACHE_HOME",
        SarsplatWarning,
        stacklevel=2,
    )
