"""`sarsplat import rslc`: an image in one or several polarisations in, a dataset of one view out."""

from __future__ import annotations

from sarsplat.cli.from_signature import comma_separated, command_of
from sarsplat.cli.importers import Contents, Recognised, dataset_name, first_readable, typed_import

command = command_of(
    __name__, "sarsplat.importers.rslc:import_rslc", pixel=comma_separated("ROW,COL", (2,), "1200,800")
)


def recognise(contents: Contents) -> Recognised | None:
    """An HDF5 file; of a folder the first that is such a one: HDF5 may hold anything."""
    from sarsplat.importers.rslc_file import is_hdf5, read_rslc

    files = contents.ending_in(".h5", ".hdf5")
    if contents.path.is_file():
        if not files or not is_hdf5(contents.path):
            return None
        read_rslc(contents.path)  # or say what is wrong with it
        files = [contents.path]
    (found, rslc), damaged = first_readable(files, read_rslc)
    if found is None or rslc is None:
        return None
    middle = f"{rslc.shape[0] // 2},{rslc.shape[1] // 2}"
    facts = {
        "mission": rslc.mission,
        "polarisations": f"{', '.join(rslc.polarisations)} (transmitted, received)",
        "size": f"{rslc.shape[0]} rows (azimuth) × {rslc.shape[1]} columns (slant range)",
        "radar": f"looks {rslc.look}, {rslc.frequency_hz / 1e9:.4g} GHz",
        **damaged,
    }
    words = ("rslc", str(found), "--pixel", middle, "--size", "METRES")
    command = typed_import(*words, out=dataset_name(found.with_suffix("")))
    return Recognised("an RSLC in NISAR's layout", facts, command)
