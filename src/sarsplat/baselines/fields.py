"""The field of SAR-NeRF: attenuation and scattering at every place, as a perceptron or as nested voxel grids."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import skip_init

from sarsplat.errors import SarsplatError
from sarsplat.gaussians.harmonics import harmonic_basis

_POSITION_OCTAVES, _DIRECTION_OCTAVES = 10, 4
_WIDTH, _DEPTH, _JOINED_AFTER, _HEAD_WIDTH = 256, 8, 4, 128
_MOST_NUMBERS = 1 << 28


class Field(nn.Module, ABC):
    """Base of the fields: attenuation and scattering at places, before their activations."""

    at_once: int
    """Places for which one step keeps everything in memory; more are computed in parts, and again on the way back."""

    @abstractmethod
    def forward(
        self, places: Float[Tensor, "p 3"], direction: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        """Attenuation and scattering at places (world frame, m) towards a radar in a direction (unit vector)."""

    @abstractmethod
    def attenuation(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        """Attenuation alone, which does not depend on the direction."""


class Perceptron(Field):
    """The published network: 8 × 256 with the input joined again, and heads of which the second sees the direction.

    Places are encoded relative to `center_m`, in units of `unit_m`. Weights and biases are at first uniform within
    ±1/√(number of inputs), drawn from a generator of the CPU.
    """

    at_once = 1 << 16
    center: Tensor

    def __init__(self, center_m: Float64[np.ndarray, " 3"], unit_m: float, generator: torch.Generator) -> None:
        super().__init__()
        position, direction = 3 * (2 * _POSITION_OCTAVES + 1), 3 * (2 * _DIRECTION_OCTAVES + 1)
        self.layers = nn.ModuleList(
            _linear(position if i == 0 else _WIDTH + position * (i == _JOINED_AFTER), _WIDTH, generator)
            for i in range(_DEPTH)
        )
        self.attenuation_head = _linear(_WIDTH, 1, generator)
        self.bottleneck = _linear(_WIDTH, _WIDTH, generator)
        self.directed = _linear(_WIDTH + direction, _HEAD_WIDTH, generator)
        self.scattering_head = _linear(_HEAD_WIDTH, 1, generator)
        self.register_buffer("center", torch.tensor(center_m, dtype=torch.float32), persistent=False)
        self.unit_m = unit_m

    def forward(
        self, places: Float[Tensor, "p 3"], direction: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        hidden = self._trunk(places)
        from_where = encoded(direction[None], _DIRECTION_OCTAVES).expand(len(places), -1)
        directed = self.directed(torch.cat([self.bottleneck(hidden), from_where], dim=1)).relu()
        return self.attenuation_head(hidden)[:, 0], self.scattering_head(directed)[:, 0]

    def attenuation(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        return self.attenuation_head(self._trunk(places))[:, 0]

    def _trunk(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, "p w"]:
        hidden = position = encoded((places - self.center.to(places)) / self.unit_m, _POSITION_OCTAVES)
        for i, layer in enumerate(self.layers):
            hidden = layer(torch.cat([position, hidden], dim=1) if i == _JOINED_AFTER else hidden).relu()
        return hidden


Box = tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"], float]
"""Two corners, m, on which outermost nodes lie, and the largest distance of neighbours in the finest lattice, m."""


class VoxelGrid(Field):
    """Numbers on the nodes of nested lattices over boxes, interpolated trilinearly and added up; no network.

    At each node lie one number for the attenuation and coefficients of spherical harmonics up to `degree` for the
    scattering; all are 0 at first. Boxes, which may overlap, have `levels` lattices each, with twice the spacing of the
    next. Interpolation is `grid_sample` with one batch: in a fixed order on the CPU, not so on a GPU.
    """

    at_once = 1 << 20
    corners: Tensor

    def __init__(self, boxes: Sequence[Box], levels: int, degree: int) -> None:
        super().__init__()
        self.degree = degree
        channels = 1 + (degree + 1) ** 2
        self.tables = nn.ParameterList()
        for low, high, voxel in boxes:
            for level in range(levels):
                nodes = [math.ceil(side / (voxel * 2**level)) + 1 for side in high - low]
                if math.prod(nodes) * channels > _MOST_NUMBERS:
                    raise SarsplatError(
                        f"a grid of {' × '.join(map(str, nodes))} nodes with {channels} numbers each is too large; "
                        "give a larger voxel or a lower degree"
                    )
                self.tables.append(nn.Parameter(torch.zeros(channels, *nodes[::-1], dtype=torch.float32)))  # z, y, x
        corners = np.array([(low, high) for low, high, _ in boxes for _ in range(levels)])
        self.register_buffer("corners", torch.from_numpy(corners), persistent=False)

    def forward(
        self, places: Float[Tensor, "p 3"], direction: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        basis = harmonic_basis(direction, self.degree)
        # the sum over harmonics first: nodes have more neighbours than numbers
        tables = [torch.stack([table[0], torch.einsum("k,kzyx->zyx", basis, table[1:])]) for table in self.tables]
        attenuation, scattering = self._between(tables, places).unbind(0)
        return attenuation, scattering

    def attenuation(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        return self._between([table[:1] for table in self.tables], places)[0]

    def total_variation(self) -> Float[Tensor, ""]:
        """Sum of the squared differences of neighbouring numbers, over all lattices and their three axes."""
        squares = [table.diff(dim=axis).square() for table in self.tables for axis in (1, 2, 3)]
        # one dimension after the other: torch splits a sum to one number by threads
        return torch.stack([square.sum(3).sum(2).sum(1).sum(0) for square in squares]).sum()

    def _between(self, tables: list[Tensor], places: Float[Tensor, "p 3"]) -> Float[Tensor, "c p"]:
        """The sum over the lattices; each falls to 0 within one of its distances beyond its box."""
        values = []
        for table, (low, high) in zip(tables, self.corners.to(places), strict=True):
            at = (2 * (places - low) / (high - low) - 1)[None, :, None, None, :]
            values.append(functional.grid_sample(table[None], at, align_corners=True)[0, :, :, 0, 0])
        return torch.stack(values).sum(0)


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Module:
    """A layer initialised as by torch, but with this generator: torch's own belongs to the user."""
    layer, bound = skip_init(nn.Linear, inputs, outputs, dtype=torch.float32), 1 / math.sqrt(inputs)
    for parameter in layer.parameters():
        nn.init.uniform_(parameter, -bound, bound, generator=generator)
    return layer


def encoded(values: Float[Tensor, "p n"], octaves: int) -> Float[Tensor, "p {(2*octaves+1)*values.shape[1]}"]:
    """Positional encoding: the values, and sine and cosine of them times 1, 2, 4 …"""
    angles = values[:, None, :] * (2.0 ** torch.arange(octaves, dtype=torch.float32)).to(values)[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=2).reshape(len(values), 2 * octaves * values.shape[1])
    return torch.cat([values, waves], dim=1)
