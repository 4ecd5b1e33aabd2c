"""`sarsplat import stack`: complex pictures of passes or polarisations and a table in, a dataset of stacks out."""

from sarsplat.cli.from_signature import command_of
from sarsplat.cli.import_folder import OPTIONS

command = command_of(__name__, "sarsplat.importers.stack:import_stack", reading="pictures from ", **OPTIONS)
