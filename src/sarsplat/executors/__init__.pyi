# ruff: isort: skip_file
from .executor import EXECUTORS as EXECUTORS, Executor as Executor, Job as Job, Means as Means, Work as Work
