# ruff: isort: skip_file
from .methods import METHODS as METHODS
from .reconstruction import reconstruct as reconstruct
from .run import Run as Run
from .tensorboard import TensorBoard as TensorBoard
from .training_loop import Step as Step
