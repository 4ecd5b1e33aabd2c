"""Methods of others under one interface, implemented afresh, to be compared with ours on the same data."""

from sarsplat.rivals.dsr import Dsr
from sarsplat.rivals.dsr_config import DSR, DsrConfig
from sarsplat.rivals.rival import Rival, Scene
from sarsplat.rivals.sar_nerf import SarNerf
from sarsplat.rivals.sar_nerf_config import SAR_NERF, SAR_NERF_GRID, SarNerfConfig

__all__ = ["DSR", "SAR_NERF", "SAR_NERF_GRID", "Dsr", "DsrConfig", "Rival", "SarNerf", "SarNerfConfig", "Scene"]
