# ruff: isort: skip_file
from .chips import Chip as Chip
from .locate import locate as locate
from .located import Located as Located
from .odds import Calibration as Calibration
from .page import files_of as files_of
from .page import runs_and_images as runs_and_images
from .page import write_files as write_files
from .write_back import write_back as write_back
