"""Imports of measured images of other formats as datasets: a module for each format, loaded when first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
