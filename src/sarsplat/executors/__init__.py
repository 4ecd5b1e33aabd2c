"""Who does jobs that do not know of each other, as runs of a sweep and tiles of a scene. Loaded when first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
