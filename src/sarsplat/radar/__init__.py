"""Radar maps of a target, and the contributors to a pixel. Modules that need torch are loaded on first use."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
