"""Published methods to compare with: SAR-NeRF, DSR, and their common base. Torch is loaded when first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
