"""Measured images of other formats become datasets: a file for each format, and what they have in common."""

from sarsplat.importers.folder import import_folder
from sarsplat.importers.images import MeasuredImage, dataset_of, summary, write_imported
from sarsplat.importers.mstar import import_mstar
from sarsplat.importers.phase_history_images import import_phase_history
from sarsplat.importers.phoenix import PhoenixChip, read_phoenix
from sarsplat.importers.rslc import import_rslc
from sarsplat.importers.sample import import_sample
from sarsplat.importers.sicd import import_sicd

__all__ = [
    "MeasuredImage",
    "PhoenixChip",
    "dataset_of",
    "import_folder",
    "import_mstar",
    "import_phase_history",
    "import_rslc",
    "import_sample",
    "import_sicd",
    "read_phoenix",
    "summary",
    "write_imported",
]
