# ruff: isort: skip_file
from .chips import Chip as Chip
from .locate import locate as locate
from .located import Located as Located
from .odds import Calibration as Calibration
