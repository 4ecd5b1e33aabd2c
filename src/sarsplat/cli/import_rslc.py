"""`sarsplat import rslc`: an image in one or several polarisations in, a dataset of one view out."""

from pathlib import Path

from sarsplat.cli.from_signature import comma_separated, command_of
from sarsplat.cli.importers import Contents, Recognised, first_described

command = command_of(
    __name__, "sarsplat.importers.rslc:import_rslc", pixel=comma_separated("ROW,COL", (2,), "1200,800")
)


def recognise(contents: Contents) -> Recognised | None:
    """Recognise HDF5 files; of a folder, the first that is an RSLC is described."""
    from sarsplat.importers.rslc_file import is_hdf5

    files = contents.ending_in(".h5", ".hdf5")
    if contents.path.is_file():
        return _described(contents.path) if files and is_hdf5(contents.path) else None
    return first_described(files, _described)


def _described(path: Path) -> Recognised:
    from sarsplat.importers.rslc_file import read_rslc

    rslc = read_rslc(path)
    facts = {
        "mission": rslc.mission,
        "polarisations": f"{', '.join(rslc.polarisations)} (transmitted, received)",
        "size": f"{rslc.shape[0]} rows (azimuth) × {rslc.shape[1]} columns (slant range)",
        "radar": f"looks {rslc.look}, {rslc.frequency_hz / 1e9:.4g} GHz",
    }
    return Recognised("an RSLC in NISAR's layout", facts)
