# ruff: isort: skip_file
from .contradictions import examine as examine
