"""Measured images of other formats become datasets: a file for each format, and what they have in common.

Each is loaded when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
