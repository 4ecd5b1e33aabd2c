"""Which methods there are; a further one is a line here and a file of its own. Needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sarsplat.baselines.config import BaselineConfig
from sarsplat.baselines.dsr_config import DSR
from sarsplat.baselines.sar_nerf_config import SAR_NERF, SAR_NERF_GRID
from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    from sarsplat.baselines.baseline import Baseline, Scene


@dataclass(frozen=True)
class Method:
    """A method that is not ours.

    Attributes
    ----------
    name : str
        On the command line and in files.
    title : str
        For readers.
    learns : str
        What it learns, for readers: `a closed mesh`.
    loss : str
        What its training minimises, for readers.
    settings : BaselineConfig
        The defaults; their type is that of all its settings.
    home : str
        Module and class of its `Baseline`, which takes a `Scene` and the settings.
    masks : bool
        Whether it learns from masks of the training images.
    """

    name: str
    title: str
    learns: str
    loss: str
    settings: BaselineConfig
    home: str
    masks: bool = False

    def build(self, scene: Scene, settings: BaselineConfig) -> Baseline:
        """Its model of a scene before the first step.

        Raises
        ------
        SarsplatError
            If the scene lacks what it learns from.
        """
        module, name = self.home.split(":")
        made: Baseline = getattr(import_module(module), name)(scene, settings)
        return made

    def read_settings(self, data: Any, source: str) -> BaselineConfig:
        """Its settings as JSON has them; see `Record.from_dict`."""
        return type(self.settings).from_dict(data, source)


_FIELD_LOSS = "squared difference of amplitudes or, in sound mode with speckle, its negative log-likelihood"

METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method(
            "sar-nerf",
            "SAR-NeRF",
            "a perceptron that knows attenuation and scattering",
            _FIELD_LOSS,
            SAR_NERF,
            "sarsplat.baselines.sar_nerf:SarNerf",
        ),
        Method(
            "sar-nerf-grid",
            "SAR-NeRF on a grid",
            "nested grids of attenuation and scattering",
            _FIELD_LOSS,
            SAR_NERF_GRID,
            "sarsplat.baselines.sar_nerf:SarNerf",
        ),
        Method(
            "dsr",
            "DSR",
            "a closed mesh",
            "sum of the losses of both masks and of the image, and of what keeps the mesh smooth",
            DSR,
            "sarsplat.baselines.dsr:Dsr",
            masks=True,
        ),
    )
}
"""By name, as on the command line: everything but our own."""


def method_named(name: str) -> Method:
    """One of `METHODS`.

    Raises
    ------
    SarsplatError
        If there is none of that name.
    """
    if name not in METHODS:
        raise SarsplatError(f"there is no method {shown(name)}; choose one of {', '.join(METHODS)}")
    return METHODS[name]
