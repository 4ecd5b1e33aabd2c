# ruff: isort: skip_file
from .config import Config as Config
from .loop import Step as Step
from .losses import LOSSES as LOSSES
from .method import Inputs as Inputs, Method as Method, Reconstruction as Reconstruction
from .methods import METHODS as METHODS
from .points import extract_points as extract_points
from .presets import PRESETS as PRESETS, preset as preset
from .run import Run as Run
from .stack_loss import stack_nats as stack_nats
from .tensorboard import TensorBoard as TensorBoard
from .trainer import Trainer as Trainer
from .training import reconstruct as reconstruct
