"""How every import ends: what was assumed, what was made, what to do next."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from sarsplat.cli import console

if TYPE_CHECKING:
    from sarsplat.data import Dataset


def finish(out: Path, dataset: Dataset) -> None:
    """Tell it."""
    from sarsplat.importers import ready

    for assumption in dataset.source["assumptions"]:
        console.say(f"assumed: {assumption}")
    console.finish(
        f"{out}: {ready(dataset)}", f"sarsplat reconstruct {shlex.quote(str(out))} --out {shlex.quote(f'{out}-run')}"
    )
