from .about import AboutImages, AboutPictures, AboutScene
from .folder import import_folder
from .images import dataset_of, summary, write_imported
from .measured_image import MeasuredImage
from .mstar import import_mstar
from .phase_history_images import import_phase_history
from .phoenix import PhoenixChip, read_phoenix
from .rslc import import_rslc
from .sample import import_sample
from .sicd import import_sicd
from .stack import import_stack

__all__ = [
    "AboutImages",
    "AboutPictures",
    "AboutScene",
    "MeasuredImage",
    "PhoenixChip",
    "dataset_of",
    "import_folder",
    "import_mstar",
    "import_phase_history",
    "import_rslc",
    "import_sample",
    "import_sicd",
    "import_stack",
    "read_phoenix",
    "summary",
    "write_imported",
]
