# ruff: isort: skip_file
from .config import Config as Config
from .presets import PRESETS as PRESETS, preset as preset
