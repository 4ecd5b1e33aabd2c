"""Render SAR images from 3D Gaussians, and reconstruct 3D targets from SAR images.

Everything public is listed in `__init__.pyi` and loaded when first used: importing the package, and the command line's
help, need no torch.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
