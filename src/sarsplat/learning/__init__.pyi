# ruff: isort: skip_file
from .losses import LOSSES as LOSSES
from .method import Inputs as Inputs, Method as Method, Reconstruction as Reconstruction
from .stack_loss import stack_nats as stack_nats
from .trainer import Trainer as Trainer
