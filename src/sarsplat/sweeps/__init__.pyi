# ruff: isort: skip_file
from .plan import Plan as Plan
from .results import Result as Result, Results as Results
from .fleet import sweep as sweep
