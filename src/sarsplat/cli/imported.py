"""How every import ends: what was assumed, how the images lie, what was made, what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sarsplat.cli import console
from sarsplat.cli.arguments import refuse_existing
from sarsplat.cli.extras import install_command
from sarsplat.errors import counted

if TYPE_CHECKING:
    from sarsplat.data import Dataset

CONTRADICTED = 1
"""Exit code of commands whose images contradict what is said of them."""


def carry_out(
    importer: Callable[..., Dataset], files: object, out: Path, *, overwrite: bool, doing: str = "", **options: Any
) -> int:
    """Call an importer, unless the output is in the way, and finish; `doing` is what is said meanwhile."""
    refuse_existing(out, overwrite, marker="dataset.json")
    with console.busy(doing) if doing else nullcontext():
        dataset = importer(files, out, overwrite=overwrite, **options)
    return finish(out, dataset)


def finish(out: Path, dataset: Dataset) -> int:
    """Print what was assumed and what contradicts it, and draw a sheet that shows the orientation.

    The exit code is 1 if the images contradict what was assumed.
    """
    from sarsplat.data.plausible import warn
    from sarsplat.importers import summary
    from sarsplat.reconstruction.contradictions import examine

    for assumption in dataset.source.get("assumptions", ()):
        console.say(f"assumed: {assumption}")
    examined = examine(dataset)
    warn(examined.contradictions)  # not what was said when the dataset was written
    try:
        _draw(out / "preview.png", dataset, examined.orientations)
    except ModuleNotFoundError as error:
        console.say(f"no preview.png was drawn, for {error.name} is not installed; {install_command('report')}")
    folder = shlex.quote(str(out))
    if examined.contradictions:
        console.finish(
            f"{out}: {summary(dataset)}, with {counted(len(examined.contradictions), 'contradiction')}",
            f"import again with what mends them (--overwrite), or look closer: sarsplat check {folder} --verbose",
        )
        return CONTRADICTED
    console.finish(
        f"{out}: {summary(dataset)}, ready", f"sarsplat reconstruct {folder} --out {shlex.quote(f'{out}-run')}"
    )
    return 0


def _draw(preview: Path, dataset: Dataset, orientations: list[tuple[str, ...]]) -> None:
    from sarsplat.data import write_bytes
    from sarsplat.report.check_sheet import check_sheet

    write_bytes(preview, check_sheet(dataset, orientations=orientations))
    console.say(f"look at {preview}: shadows must fall downwards, and a target's nose point along the dotted arrow")
