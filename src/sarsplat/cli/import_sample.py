"""`sarsplat import sample`: the SAMPLE set's MATLAB files in, a dataset out."""

from collections import Counter

from sarsplat.cli.from_signature import Option, command_of
from sarsplat.cli.importers import Contents, Recognised

command = command_of(
    __name__, "sarsplat.importers.sample:import_sample", reading="images from ", target=Option(name="class")
)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise files named like those of the set."""
    from sarsplat.importers.sample import named_as_sample

    names = [name for name in map(named_as_sample, contents.ending_in(".mat")) if name is not None]
    if not names:
        return None
    by_kind = sorted(Counter((name.target, name.kind) for name in names).items())
    facts = {f"class {target}": f"{number} {kind}" for (target, kind), number in by_kind}
    return Recognised("images of the SAMPLE set (complex, MATLAB files)", facts)
