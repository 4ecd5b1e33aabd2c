"""Files in and out: datasets, Gaussians and points, checkpoints."""

from sarsplat.data.checkpoint import load_checkpoint, save_checkpoint
from sarsplat.data.dataset import Dataset, DatasetEntry
from sarsplat.data.dataset_folder import read_dataset, write_dataset
from sarsplat.data.files import read_json, read_versioned_json, write_bytes, write_json
from sarsplat.data.folders import new_folder
from sarsplat.data.geotiff import read_terrain, write_terrain
from sarsplat.data.image import SarImage
from sarsplat.data.masks import Mask, Masks, read_masks
from sarsplat.data.mesh import write_mesh
from sarsplat.data.ply import read_gaussians_ply, read_points_ply, write_gaussians_ply, write_points_ply
from sarsplat.data.tiff import read_tiff, write_tiff

__all__ = [
    "Dataset",
    "DatasetEntry",
    "Mask",
    "Masks",
    "SarImage",
    "load_checkpoint",
    "new_folder",
    "read_dataset",
    "read_gaussians_ply",
    "read_json",
    "read_masks",
    "read_points_ply",
    "read_terrain",
    "read_tiff",
    "read_versioned_json",
    "save_checkpoint",
    "write_bytes",
    "write_dataset",
    "write_gaussians_ply",
    "write_json",
    "write_mesh",
    "write_points_ply",
    "write_terrain",
    "write_tiff",
]
