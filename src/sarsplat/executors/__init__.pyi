# ruff: isort: skip_file
from .job import Job as Job, Work as Work
from .executor import EXECUTORS as EXECUTORS, Executor as Executor, Means as Means
