"""Truth for experiments, independent of the renderer: targets, ray caster, speckle, protocols; loaded lazily."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
