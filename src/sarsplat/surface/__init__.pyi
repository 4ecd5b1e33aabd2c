# ruff: isort: skip_file
from .points import extract_points as extract_points
