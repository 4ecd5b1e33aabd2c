"""What takes long to make again, kept in the user's cache folder: $XDG_CACHE_HOME/sarsplat, or ~/.cache/sarsplat."""

from __future__ import annotations

import hashlib
import os
import tempfile
import warnings
from functools import cache
from pathlib import Path

from sarsplat.errors import SarsplatWarning


def read(name: str) -> bytes | None:
    """What was written under that name; None if there is nothing, or its checksum does not hold."""
    try:
        content = (_folder() / name).read_bytes()
    except OSError:
        return None
    digest, kept = content[:32], content[32:]
    return kept if hashlib.sha256(kept).digest() == digest else None


def write(name: str, content: bytes) -> None:
    """Keep it for the next program; warn once where that is not possible."""
    folder = _folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, delete=False) as file:
            temporary = Path(file.name)
            try:
                file.write(hashlib.sha256(content).digest() + content)
                file.flush()
                os.fsync(file.fileno())
                file.close()  # Windows replaces closed files only
                temporary.replace(folder / name)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
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
