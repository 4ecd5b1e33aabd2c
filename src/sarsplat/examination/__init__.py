"""Checks of a dataset against its own images: near range, azimuths, unit, speckle, resolution."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
