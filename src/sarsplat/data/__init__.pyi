from .checkpoint import load_checkpoint, save_checkpoint
from .dataset import Dataset, DatasetEntry
from .dataset_folder import read_dataset, write_dataset
from .files import new_file, read_json, read_versioned_json, write_bytes, write_json
from .folders import new_folder
from .image import SarImage
from .mesh import write_mesh
from .ply import read_gaussians_ply, write_gaussians_ply
from .ply_points import read_points_ply, write_points_ply
from .sidecar import Mask, Masks, read_masks
from .terrain_file import read_terrain, write_terrain
from .tiff import read_tiff, write_tiff

__all__ = [
    "Dataset",
    "DatasetEntry",
    "Mask",
    "Masks",
    "SarImage",
    "load_checkpoint",
    "new_file",
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
