"""Fields of SAR-NeRF: attenuation and scattering as a perceptron or nested voxel grids, their samples and surface."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import skip_init

from sarsplat.errors import SarsplatError
from sarsplat.extras import needed
from sarsplat.gaussians.law_harmonics import harmonic_basis
from sarsplat.geometry import ImageGrid, View

_POSITION_OCTAVES, _DIRECTION_OCTAVES = 10, 4
_WIDTH, _DEPTH, _JOINED_AFTER, _HEAD_WIDTH = 256, 8, 4, 128
_MOST_NUMBERS = 1 << 28
_LAYER_PLACES = 1 << 18  # evaluated at once for a surface


class Field(nn.Module, ABC):
    """Base of fields: attenuation and scattering at places, before their activations."""

    at_once: int
    """Maximum number of places whose activations one step stores; beyond, parts are computed again backwards."""

    @abstractmethod
    def forward(
        self, places: Float[Tensor, "p 3"], direction: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        """Attenuation and scattering at places (world frame, m) towards a radar in a direction (unit vector)."""

    @abstractmethod
    def attenuation(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        """Attenuation at places, which is independent of the direction."""


class Perceptron(Field):
    """Published network: 8 × 256 with a skip connection, and two heads, of which the second gets the direction.

    Places are encoded relative to `center_m`, in units of `unit_m`. Initial weights and biases are uniform within
    ±1/√(number of inputs), drawn from `generator`, which is on the CPU.
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
        code = encoded(direction[None], _DIRECTION_OCTAVES).expand(len(places), -1)
        directed = self.directed(torch.cat([self.bottleneck(hidden), code], dim=1)).relu()
        return self.attenuation_head(hidden)[:, 0], self.scattering_head(directed)[:, 0]

    def attenuation(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        return self.attenuation_head(self._trunk(places))[:, 0]

    def _trunk(self, places: Float[Tensor, "p 3"]) -> Float[Tensor, "p w"]:
        hidden = position = encoded((places - self.center.to(places)) / self.unit_m, _POSITION_OCTAVES)
        for i, layer in enumerate(self.layers):
            hidden = layer(torch.cat([position, hidden], dim=1) if i == _JOINED_AFTER else hidden).relu()
        return hidden


Box = tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"], float]
"""Low and high corner, m, and the largest distance of neighbouring nodes in the finest lattice, m."""


class VoxelGrid(Field):
    """Sum of nested lattices over boxes, interpolated trilinearly; no network.

    Each node has one number for the attenuation and coefficients of spherical harmonics up to `degree` for the
    scattering; all are 0 initially. Each box has `levels` lattices, each with twice the spacing of the next; boxes may
    overlap. The order of additions in `grid_sample` is fixed on the CPU, but not on a GPU.
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
        # summing harmonics before interpolation is cheaper
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
        """Sum of the interpolated lattices; each falls to 0 within one spacing beyond its box."""
        values = []
        for table, (low, high) in zip(tables, self.corners.to(places), strict=True):
            normalised = (2 * (places - low) / (high - low) - 1)[None, :, None, None, :]
            values.append(functional.grid_sample(table[None], normalised, align_corners=True)[0, :, :, 0, 0])
        return torch.stack(values).sum(0)


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Module:
    """Linear layer with torch's initialisation, but this generator: torch's global one belongs to the user."""
    layer, bound = skip_init(nn.Linear, inputs, outputs, dtype=torch.float32), 1 / math.sqrt(inputs)
    for parameter in layer.parameters():
        nn.init.uniform_(parameter, -bound, bound, generator=generator)
    return layer


def encoded(values: Float[Tensor, "p n"], octaves: int) -> Float[Tensor, "p {(2*octaves+1)*values.shape[1]}"]:
    """Positional encoding: the values, and the sines and cosines of 1, 2, 4 … times the values."""
    angles = values[:, None, :] * (2.0 ** torch.arange(octaves, dtype=torch.float32)).to(values)[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=2).reshape(len(values), 2 * octaves * values.shape[1])
    return torch.cat([values, waves], dim=1)


def level_of_half(depths: Sequence[Float[Tensor, "n r"]]) -> float:
    """Level of the surface: median over rays of the optical depth of the first cell at which half is absorbed.

    Cells of each ray go from near to far; inf if no ray is half absorbed.
    """
    at_half = []
    for depth in depths:
        half = depth.cumsum(1) >= math.log(2)
        at_half.append(depth.gather(1, half.to(torch.int8).argmax(1, keepdim=True))[half.any(1)])
    cells = torch.cat(at_half)
    return float(cells.median()) if len(cells) else math.inf


def isosurface(
    values: Callable[[Tensor], Tensor],
    low_m: Float64[np.ndarray, " 3"],
    high_m: Float64[np.ndarray, " 3"],
    longest: int,
    level: float,
    like: Tensor,
) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "f 3"]]:
    """Extract the surface at which a field falls below a level, by marching cubes; it is open at the walls of the box.

    `values` maps places [P, 3], m, of the dtype and device of `like`, to the field's values [P]; the box has `longest`
    cubic voxels along its longest side. Returns vertices [N, 3], m, and faces [F, 3], counter-clockwise seen from low
    values; both are empty if no value or every value reaches the level.
    """
    with needed("mesh", "a surface"):
        from skimage.measure import marching_cubes
    voxel = float((high_m - low_m).max()) / longest
    shape = np.maximum(1, np.ceil((high_m - low_m) / voxel - 0.5 - 1e-9)).astype(int)  # centres lie in the box
    x, y, z = (torch.from_numpy(low + (np.arange(n) + 0.5) * voxel).to(like) for low, n in zip(low_m, shape))
    layers = np.zeros(shape, np.float32)
    step = max(1, _LAYER_PLACES // (len(y) * len(z)))
    for first in range(0, len(x), step):
        places = torch.stack(torch.meshgrid(x[first : first + step], y, z, indexing="ij"), dim=-1)
        layer = values(places.reshape(-1, 3)).reshape(places.shape[:3])
        layers[first : first + len(layer)] = layer.cpu().numpy()
    if min(shape) < 2 or not layers.min() < level < layers.max():
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(
        layers, level, spacing=(voxel,) * 3, gradient_direction="ascent", allow_degenerate=False
    )
    return vertices.astype(np.float64) + (low_m + voxel / 2), faces.astype(np.int64)


# ---- samples: azimuth × rays in elevation × range (docs/concepts/baselines-sar-nerf.md) ------------------------------
@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of one view through a box."""

    turn: Float64[np.ndarray, "3 3"]
    """Rotation from the world to the radar frame."""
    azimuth_m: Float64[np.ndarray, " a"]
    range_m: Float64[np.ndarray, " r"]
    """Centres of the sampled columns (`azimuth_m`) and rows (`range_m`), m."""
    first_column: int
    first_row: int
    """Column and row of the first sampled pixel."""
    elevation_m: tuple[float, float]
    """Limits of the box in elevation (across the line of sight), m."""
    count: int
    """Number of rays per column, one in each of as many strata of equal width."""

    @classmethod
    def through(
        cls,
        view: View,
        grid: ImageGrid,
        low_m: Float64[np.ndarray, " 3"],
        high_m: Float64[np.ndarray, " 3"],
        count: int,
        *,
        whole: bool,
    ) -> "Rays":
        """Rays through a box; `whole` samples all pixels of the grid, else only those that show the box."""
        turn = view.look.frame
        middle, half = turn @ (low_m + high_m) / 2, np.abs(turn) @ (high_m - low_m) / 2
        columns = slice(0, grid.columns) if whole else _within(grid.azimuth_m, grid.spacing_m[0], middle[0], half[0])
        rows = slice(0, grid.rows) if whole else _within(grid.range_m, grid.spacing_m[1], middle[2], half[2])
        edges = float(middle[1] - half[1]), float(middle[1] + half[1])
        return cls(turn, grid.azimuth_m[columns], grid.range_m[rows], columns.start, rows.start, edges, count)

    @property
    def spacing_m(self) -> float:
        """Width of a stratum, m: the share of the elevation that one ray stands for."""
        return (self.elevation_m[1] - self.elevation_m[0]) / self.count

    def offsets(self, generator: torch.Generator | None) -> Float64[Tensor, "a {self.count}"]:
        """Elevation of every ray, m, float64 [A, K]: random in its stratum, or without generator the middle of it."""
        within = torch.full((len(self.azimuth_m), self.count), 0.5, dtype=torch.float64)
        if generator is not None:
            within = torch.rand(within.shape, dtype=torch.float64, generator=generator)
        return self.elevation_m[0] + (torch.arange(self.count) + within) * self.spacing_m

    def places(
        self, offsets: Float64[Tensor, "a k"], columns: slice, like: Tensor
    ) -> Float[Tensor, "c k {len(self.range_m)} 3"]:
        """Sampled places of a slice of columns, world frame, m, near to far, with dtype and device of `like`."""
        elevation = offsets[columns].to(like)
        azimuth = torch.from_numpy(self.azimuth_m[columns]).to(like)
        along = torch.from_numpy(self.range_m).to(like)
        x, y, z = torch.from_numpy(self.turn).to(like).unbind(0)
        return azimuth[:, None, None, None] * x + elevation[:, :, None, None] * y + along[:, None] * z


def _within(centres: Float64[np.ndarray, " n"], spacing: float, middle: float, half: float) -> slice:
    """Slice of the pixels that overlap middle ± half."""
    pixels = np.flatnonzero(np.abs(centres - middle) < half + spacing / 2)
    return slice(int(pixels[0]), int(pixels[-1]) + 1) if len(pixels) else slice(0, 0)
