# ruff: isort: skip_file
from .baseline import Baseline as Baseline, BaselineConfig as BaselineConfig, Scene as Scene
from .method import BaselineMethod as BaselineMethod
