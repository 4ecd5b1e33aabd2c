"""`sarsplat import stack`: complex pictures of passes or polarisations and a table in, a dataset of stacks out."""

from sarsplat.cli.from_signature import command_of
from sarsplat.cli.import_folder import OPTIONS, described
from sarsplat.cli.importers import Contents, Recognised

command = command_of(__name__, "sarsplat.importers.stack:import_stack", reading="pictures from ", **OPTIONS)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise pictures with a table (CSV) of passes or polarisations."""
    return described(contents, stacks=True)
