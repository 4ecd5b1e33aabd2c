"""`sarsplat import sample`: the SAMPLE set's MATLAB files in, a dataset out."""

from __future__ import annotations

from collections import Counter

from sarsplat.cli.from_signature import Option, command_of
from sarsplat.cli.importers import Contents, Recognised, training_half, typed_import

command = command_of(
    __name__, "sarsplat.importers.sample:import_sample", reading="images from ", target=Option(name="class")
)


def recognise(contents: Contents) -> Recognised | None:
    """Files named like those of the set."""
    from sarsplat.importers.sample import named_as_sample

    names = [name for name in map(named_as_sample, contents.ending_in(".mat")) if name is not None]
    if not names:
        return None
    by_kind = Counter((name.target, name.kind) for name in names)
    target, kind = max(by_kind, key=lambda its: (by_kind[its], its[1] == "real"))
    facts = {f"class {target}": f"{number} {kind}" for (target, kind), number in sorted(by_kind.items())}
    words = ("--class", target, "--kind", kind, "--train-views", training_half(by_kind[target, kind]))
    folder = contents.path if contents.path.is_dir() else contents.path.parent
    command = typed_import("sample", str(folder), *words, out=f"sample-{target}")
    return Recognised("images of the SAMPLE set (complex, MATLAB files)", facts, command)
