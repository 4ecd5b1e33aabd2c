"""Measured images of other formats become datasets: a file for each format, and what they have in common.

MSTAR's chips are read in `sarsplat.data`.
"""

from sarsplat.importers.folder import import_folder
from sarsplat.importers.images import MeasuredImage, dataset_of, ready, write_imported
from sarsplat.importers.phase_history_images import import_phase_history
from sarsplat.importers.sample import import_sample
from sarsplat.importers.sicd import import_sicd

__all__ = [
    "MeasuredImage",
    "dataset_of",
    "import_folder",
    "import_phase_history",
    "import_sample",
    "import_sicd",
    "ready",
    "write_imported",
]
