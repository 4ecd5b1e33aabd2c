"""Measured images of other formats become datasets: a file for each format, and what they have in common.

MSTAR's chips are read in `sarsplat.data`.
"""

from sarsplat.importers.folder import import_folder
from sarsplat.importers.images import MeasuredImage, dataset_of, ready, write_imported

__all__ = ["MeasuredImage", "dataset_of", "import_folder", "ready", "write_imported"]
