"""How every import ends: what was assumed, how the images lie, what was made, what to do next."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sarsplat.cli import console
from sarsplat.cli.arguments import refuse_existing
from sarsplat.cli.extras import install_command
from sarsplat.errors import counted

if TYPE_CHECKING:
    from sarsplat.data import Dataset
    from sarsplat.examination.outcome import Examination

CONTRADICTED = 1
"""Exit code of commands whose images contradict what is said of them."""


def carry_out(
    importer: Callable[..., Dataset], files: object, out: Path, *, overwrite: bool, doing: str = "", **options: Any
) -> int:
    """Call an importer, unless the output is in the way, and finish; `doing` is what is said meanwhile."""
    from sarsplat.data.dataset_folder import HEADER
    from sarsplat.examination.contradictions import examine
    from sarsplat.importers.images import EXAMINATIONS

    refuse_existing(out, overwrite, marker=HEADER)
    contradictions: list[str] = []
    with _warned_later(contradictions), console.busy(doing) if doing else nullcontext():
        dataset = importer(files, out, overwrite=overwrite, **options)
        examined = EXAMINATIONS.get(dataset) or examine(dataset)
        contradictions += examined.contradictions
    return _finish(out, dataset, examined)


@contextmanager
def _warned_later(contradictions: list[str]) -> Iterator[None]:
    """Warnings inside of the block are said after it, but for those of what contradicts the dataset."""
    held: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as held:
            yield
    finally:
        for one in held:
            if str(one.message) not in contradictions:
                warnings.showwarning(one.message, one.category, one.filename, one.lineno)


def _finish(out: Path, dataset: Dataset, examined: Examination) -> int:
    """Print what was assumed and what contradicts it, and draw a sheet that shows the orientation.

    The exit code is 1 if the images contradict what was assumed.
    """
    from sarsplat.examination.plausible import warn
    from sarsplat.importers import summary
    from sarsplat.regions.target_region import box_misses

    for assumption in dataset.source.get("assumptions", ()):
        console.say(f"assumed: {assumption}")
    for text in examined.contradictions:
        console.complain(text)
    warn(box_misses(dataset))
    try:
        _draw(out / "preview.png", dataset, examined.orientations)
    except ModuleNotFoundError as error:
        console.say(f"no preview.png was drawn, for {error.name} is not installed; {install_command('report')}")
    folder = shlex.quote(str(out))
    if examined.contradictions:
        console.finish(
            f"{out}: {summary(dataset)}, with {counted(len(examined.contradictions), 'contradiction')}",
            "import again with --overwrite and the options that mend it, or look closer with "
            f"sarsplat check {folder} --verbose",
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
