"""`sarsplat view`: a page on this machine in which the radar is dragged around the target. Needs the extra `view`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
