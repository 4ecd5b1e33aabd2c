"""Class and azimuth of measured images by rendering reconstructions from all around; loaded when first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
