"""The training log, `metrics.jsonl`: one JSON object a line."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec

from sarsplat.data.files import open_file
from sarsplat.errors import SarsplatError

_LONGEST = 1 << 22  # bytes; a training writes some tens of thousands


class LogLine(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of a training's log; the number of Gaussians is there if any are learned."""

    iteration: Annotated[int, msgspec.Meta(ge=0, le=10**9)]
    seconds: Annotated[float, msgspec.Meta(ge=0, le=1e10)]
    loss: Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]
    gaussians: Annotated[int, msgspec.Meta(ge=0, le=10**9)] | None = None


def log_text(lines: Iterable[LogLine]) -> bytes:
    """Log lines as `metrics.jsonl` has them."""
    return b"".join(msgspec.json.encode(line) + b"\n" for line in lines)


def read_log(path: Path) -> list[LogLine]:
    """The lines up to the first that a crash has torn; none if there is no file. Refused if longer than 4 MiB."""
    if not path.is_file():
        return []
    with open_file(path) as file:
        data = file.read(_LONGEST + 1)
    if len(data) > _LONGEST:
        raise SarsplatError(f"{path} is longer than {_LONGEST} bytes, which no training produces; remove it")
    history: list[LogLine] = []
    for line in data.splitlines():
        try:
            history.append(msgspec.json.decode(line, type=LogLine))
        except (msgspec.MsgspecError, UnicodeDecodeError):
            break
    return history
