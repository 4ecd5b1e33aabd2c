# ruff: isort: skip_file
from .executor import EXECUTORS as EXECUTORS, Executor as Executor, Means as Means
from .plan import Plan as Plan
from .results import Result as Result, Results as Results
from .fleet import sweep as sweep
