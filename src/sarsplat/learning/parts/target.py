"""The target: Gaussians with learned means, orientations, scales, optical depths and scattering, and their dropout."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from sarsplat.arguments import described
from sarsplat.data import Dataset
from sarsplat.errors import SarsplatError
from sarsplat.gaussians import MIN_SCALE, Gaussians, Harmonics, Scattering, scattering_named
from sarsplat.gaussians.initialise import BRIGHT_DB, Region, hemisphere_shell, random_quaternions
from sarsplat.geometry import ImageGrid, Stack
from sarsplat.learning.parts.part import Learned, Parameters, Part, column_means, exact_scale, late, normal_nats
from sarsplat.learning.scene_frame import Levels, SceneFrame
from sarsplat.radiometry import brighter, usual_peak
from sarsplat.regions.outlines import levels_db, outline
from sarsplat.regions.stack_region import enough_gaussians, imaged_sample
from sarsplat.renderer import Bounds, render
from sarsplat.renderer.checks import MAX_SCALE
from sarsplat.renderer.engines.on_device import kept_on_device
from sarsplat.renderer.point_queries import at_places
from sarsplat.settings.config import Config

_MIN_OPTICAL_DEPTH = 1e-3
_FAINT = 0.05  # optical depth of a faint Gaussian, the scale of the sparsity prior

_INITIAL_WIDTHS = (1.0, 1.0, 0.9)
"""Relative initial widths of an oriented Gaussian: rounding must not decide which axis is the shortest."""

_OVER_P_MIN = 2.0  # minimum γ⁰ at the start, in P_min, near which the scattering has no gradient
_SIMILAR = 0.6  # scale of the scattering penalty: larger differences of parameters cost little more
_ALIKE = 6.0  # side of the cubes within which scattering is alike, resolution cells
_PARTS = 4  # number of these along a larger cube, whose scattering differs little between them
_LEAST = 3.0  # number of Gaussians as which the mean of the larger cube counts in that of a cube
_STEP, _SEED = 0x9E3779B97F4A7C15, 0xD1B54A32D192ED03  # odd multipliers that spread step and seed over 64 bits

_MIX = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
"""Steele, Lea & Flood, Fast splittable pseudorandom number generators, 2014, as improved by Stafford (variant 13)."""

_BITS = 24  # of the hash that decide
_MAX_SHARE = 0.4  # maximum share dropped because there are few views


class Target(Part):
    """Gaussians in the space that the images bound."""

    order = 10

    def __init__(self, config: Config, frame: SceneFrame, device: torch.device) -> None:
        super().__init__(config, frame, device)
        self._cell_m = frame.cell_m
        self._levels = Levels.of(config, frame)
        self._corners = [corner.tolist() for corner in self._box]

    def look_at(self, cell_m: float) -> None:
        self._cell_m = cell_m

    @property
    def learned(self) -> dict[str, Learned]:
        config, rates = self.config, self.config.rates
        lowest, highest = self._box
        smallest, _, largest = scales_m(config, self._cell_m, self._levels.coarsest)
        columns, ranges = self._own, self._common

        def falling(done: float) -> float:
            return (rates.means_end / rates.means) ** done

        learned = {
            "means": Learned((None, 3), (rates.means * self._cell_m,), falling, lowest, highest),
            "quaternions": Learned((None, 4), (rates.quaternions,)),
            "scales": Learned((None, 3), (rates.log_scales,), low=smallest, high=largest, logarithmic=True),
            "optical_depth": Learned(
                (None,),
                (rates.log_optical_depth,),
                low=_MIN_OPTICAL_DEPTH,
                high=config.max_optical_depth,
                logarithmic=True,
            ),
            "scattering": Learned((None, columns), (rates.scattering, *[rates.directional_scattering] * (columns - 1))),
        }
        if ranges:
            low, high = torch.tensor(ranges, dtype=torch.float32, device="cpu").T
            learned["law"] = Learned((1, len(ranges)), (rates.law,), partial(late, begin=config.law_from), low, high)
        return learned

    def initial(self, train: Dataset, generator: torch.Generator) -> Parameters:
        config = self.config
        sample = hemisphere_shell if config.initialisation == "hemisphere" else Region.sample
        region, views, grid = self.frame.region, train.views, train.grid
        if self.frame.stacks:
            needed = enough_gaussians(region, views, grid, self.frame.stacks)
            n = config.gaussians or max(config.fewest_gaussians, needed)
            means = torch.from_numpy(imaged_sample(region, views, grid, n, generator)).float()
        else:
            n = config.gaussians or max(
                config.fewest_gaussians, round(config.gaussians_per_cell * _cells(train) / self._levels.coarsest**1.4)
            )
            means = torch.from_numpy(sample(region, n, generator)).float()
        quaternions, depth = random_quaternions(n, generator), means.new_full((n,), config.initial_optical_depth)
        scales = means.new_tensor(_start_scales_m(config, self._coarsest.cell_m)).repeat(n, 1)
        gamma0 = config.initial_scattering
        shows_more = train.ground or config.ground or config.surroundings or self.frame.stacks
        outshone = usual_peak(train.power) < train.power.max()  # by corner reflectors, which begin bright
        if not (outshone or shows_more or config.box_m or train.target_box_m):
            first = Gaussians(means, quaternions, scales, depth, Harmonics.initial(n, 1.0, 0.0))
            returned = _returned_gamma0(first, train, self._coarsest) / self.frame.unit
            gamma0 = max(gamma0 * min(returned, 1.0), _OVER_P_MIN * config.p_min)
        scattering = law(config, n, gamma0, self.frame.stacks)
        return {
            "means": means,
            "quaternions": quaternions,
            "scales": scales,
            "optical_depth": depth,
            "scattering": scattering.parameters[:, : self._own].contiguous(),
        } | ({"law": self._law.parameters[:, self._own :].clone()} if self._common else {})

    def nats(self, p: Parameters) -> Iterator[Float[Tensor, ""]]:
        """Priors: most Gaussians are nearly transparent (sparsity), and scattering varies little with direction."""
        config, scattering = self.config, p["scattering"]
        if config.sparsity:
            filled = torch.log1p(p["optical_depth"] / _FAINT)
            yield config.sparsity * len(filled) * column_means(filled[:, None]).sum()
        if config.directional_std is not None and scattering.shape[1] > 1:
            uniform = self._scattering(p, 0)
            upwards = torch.eye(3, dtype=scattering.dtype, device=scattering.device)[2:]  # made on the device
            level = uniform.amplitudes(upwards, p["quaternions"], p["scales"])[0, :, uniform.power_channel]
            yield normal_nats(scattering[:, 1:] / (config.directional_std * level[:, None].detach()), 1.0)

    def penalties(self, p: Parameters) -> Iterator[tuple[str, Float[Tensor, ""]]]:
        """Penalties on differences of scattering between Gaussians, and of the shared exponents from their start."""
        if self.config.scattering_penalty:
            yield "scattering penalty", self.config.scattering_penalty * _spread(p, self._corners, self._cell_m)
        if self.config.law_penalty and "law" in p:
            yield "law penalty", self.config.law_penalty * ((p["law"] - self._usual) ** 2).sum(1).sum(0)

    def gaussians(self, p: Parameters, degree: int, dropped: Bool[Tensor, " n"] | None) -> Gaussians:
        """Gaussians with harmonics up to `degree`; those not `dropped` get more optical depth in compensation."""
        depth = p["optical_depth"]
        if dropped is not None:
            share_left = 1 - share_dropped(self.config, len(self.frame.views))
            raised = (depth / share_left).clamp(max=self.config.max_optical_depth)
            depth = torch.where(dropped, 0.0, raised)
        return Gaussians(self._lifted(p["means"]), p["quaternions"], p["scales"], depth, self._scattering(p, degree))

    def bounds(self) -> Bounds:
        """Bounds of the Gaussians in every step, the first included."""
        config, (low, high) = self.config, self._box
        depth = max(config.max_optical_depth, config.initial_optical_depth)
        if self.frame.terrain is not None:
            below, above = self.frame.terrain.span_m
            low, high = low + low.new_tensor([0, 0, below]), high + high.new_tensor([0, 0, above])
        largest = max(scales_m(config, self._coarsest.cell_m, self._levels.coarsest))
        return Bounds((*low.tolist(),), (*high.tolist(),), largest, depth, self.device)

    def _scattering(self, p: Parameters, degree: int) -> Scattering:
        """Scattering of all Gaussians, their own parameters before the shared ones."""
        rows = p["scattering"]
        if "law" in p:
            twice = p["law"].repeat(1, 2)  # its gradient is summed over two or more columns, as in `column_means`
            rows = torch.cat([rows, twice.expand(len(rows), -1)[:, : p["law"].shape[1]]], dim=1)
        return replace(self._law, parameters=rows).detailed(degree)

    def _lifted(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Centres in the world frame: the parameter's z is relative to the terrain."""
        if self._heights is None:
            return means
        heights, (dx, dy) = self._heights
        x, y, z = means.unbind(1)
        return torch.stack([x, y, z + at_places(heights, x / dx, y / dy, 1.0)], dim=1)

    @cached_property
    def _heights(self) -> tuple[Float[Tensor, "ny nx"], tuple[float, float]] | None:
        """Heights of the terrain and their spacing, m; None on level ground."""
        terrain = self.frame.terrain
        if terrain is None:
            return None
        return torch.from_numpy(terrain.heights_m).float().to(self.device), terrain.pitch_m

    @property
    def _coarsest(self) -> ImageGrid:
        """Grid of the first level's images."""
        return self.frame.grid.multilooked(self._levels.coarsest)

    @cached_property
    def _law(self) -> Scattering:
        return law(self.config, 1, 0.0, self.frame.stacks)

    @property
    def _common(self) -> tuple[tuple[float, float], ...]:
        """Ranges of the scattering parameters shared by all Gaussians."""
        return self._law.common if self.config.common_law else ()

    @cached_property
    def _usual(self) -> Float[Tensor, "1 k"]:
        """Initial values of the scattering parameters shared by all Gaussians."""
        return self._law.parameters[:, self._own :].to(self.device)

    @property
    def _own(self) -> int:
        """Number of scattering parameters per Gaussian, the first columns; the last ones are shared."""
        return self._law.parameters.shape[1] - len(self._common)

    @cached_property
    def _box(self) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        """Corners of the box of the target's centres, m, on the CPU."""
        region = self.frame.region
        low, high = (torch.from_numpy(corner).float() for corner in (region.low, region.high))
        if self.config.initialisation == "hemisphere":  # the shell reaches beyond the region
            half = (high - low).norm() / 2
            centre = (low + high) / 2
            low, high = torch.minimum(low, centre - half), torch.maximum(high, centre + half)
        margin = self.config.margin * self.frame.cell_m
        low, high = low - margin, high + margin
        if self.config.ground is not None:
            low[2] = low[2].clamp(min=0.0)  # not below the ground
        return low, high


def _spread(p: Parameters, box: list[list[float]], cell_m: float) -> Float[Tensor, ""]:
    """Spread of scattering around the mean of a cube, and of that around the mean of a larger one, both held constant.

    Materials differ from part to part: compared with the mean of all, dim walls would rather be transparent. It is
    the negative logarithm of Student's t-distribution, up to factors: quadratic at first, flat for large differences.
    """
    rows, side_m = p["scattering"], _ALIKE * cell_m
    held = rows.detach()
    with torch.no_grad():
        first, last = ([math.floor(place / side_m) for place in corner] for corner in box)
        larger = [(end - begin) // _PARTS + 1 for begin, end in zip(first, last, strict=True)]
        _, ny, nz = (_PARTS * count for count in larger)
        x, y, z = (p["means"] / side_m).floor().long().unbind(1)
        x0, y0, z0 = first
        cube = (x * (ny * nz) + y * nz + (z - (x0 * ny + y0) * nz - z0)) % (count := math.prod(larger) * _PARTS**3)
        values = nn.functional.pad(held, (0, 1), value=1.0)
        scale = exact_scale(values)
        whole = torch.zeros(count, values.shape[1], dtype=torch.int64, device=values.device)
        whole.index_add_(0, cube, (values * scale).long())
        whole = whole.view(*(size for along in larger for size in (along, _PARTS)), -1)
        (own, n), (above, m) = ((t / scale).tensor_split([-1], 6) for t in (whole, whole.sum((1, 3, 5), keepdim=True)))
        above = above / m
        mean = (own + _LEAST * above) / (n + _LEAST)
        usual = torch.cat([mean, mean - above], dim=6).flatten(0, 5).to(rows.dtype)[cube]
    mean, deviation = usual.chunk(2, dim=1)
    difference = torch.cat([rows - mean, deviation + (rows - held)], dim=1) / _SIMILAR
    return _SIMILAR**2 * column_means((difference**2).log1p()).sum()


def law(config: Config, count: int, gamma0: float, stacks: Sequence[Stack] = ()) -> Scattering:
    """Initial scattering of a training by the configuration's law, in the polarisations of stacks, if any.

    Raises if a custom law returns something else.
    """
    kind = scattering_named(config.scattering)
    made = kind.initial(count, gamma0, config.p_min)
    shape = [*made.parameters.shape] if type(made) is kind else []
    if shape[:1] != [count] or shape[-1] <= len(kind.common) or made.parameters.dtype != torch.float32:
        what = f"{made.parameters.dtype} {list(made.parameters.shape)}" if type(made) is kind else described(made)
        raise SarsplatError(
            f"{kind.__name__}.initial({count}, …) returned {what}; it must return a {kind.__name__} whose parameters "
            f"are torch.float32 [{count}, K], with K above the {len(kind.common)} ranges of {kind.__name__}.common"
        )
    polarisations = tuple(dict.fromkeys(stacks[0].of_channels)) if stacks else ()
    return (made.for_polarisations(polarisations) if len(polarisations) > 1 else made).detailed(config.harmonics_degree)


def scales_m(config: Config, cell_m: float, coarsest: int = 1) -> tuple[float, float, float]:
    """Smallest, initial and largest standard deviation of a Gaussian, m; raise if they cannot be rendered.

    The largest grows with the scene, by the sixth root of the first level's factor, `coarsest`.
    """
    smallest, first, largest = (
        cells * cell_m
        for cells in (config.scale_bounds[0], config.initial_scale, config.scale_bounds[1] * coarsest ** (1 / 6))
    )
    for name, scale in (("initial_scale", first), ("scale_bounds", largest)):
        if not MIN_SCALE <= scale <= MAX_SCALE:
            raise SarsplatError(
                f"{name} makes Gaussians of {scale:.3g} m from resolution cells of {cell_m:.3g} m, and only "
                f"{MIN_SCALE:g} m to {MAX_SCALE:g} m can be rendered; choose another, or check the grid's metres"
            )
    return max(smallest, MIN_SCALE), first, largest


def _returned_gamma0(gaussians: Gaussians, train: Dataset, grid: ImageGrid) -> float:
    """γ⁰ with which Gaussians would return each image's power: the upper quartile over the training views.

    By the mean, views in which the target is bright would begin too dark. `grid` sets the rays.
    """
    ones, found = gaussians.means.new_ones(1, len(gaussians), 1), list[float]()
    for view, image in zip(train.views, train.power, strict=True):
        lit_m2 = render(gaussians, [view], grid, amplitudes=ones).lit_area.numpy().sum(dtype=np.float64)
        power = float(image.sum(dtype=np.float64)) * math.prod(train.grid.spacing_m)
        found.append(power / max(lit_m2, grid.cell_m**2))
    return float(np.quantile(found, 0.75))


def _cells(train: Dataset) -> float:
    """Mean number of resolution cells that the target covers in a training image."""
    if train.ground:
        pixels = sum(outline(level).target.sum() for level in levels_db(train.power, train.grid, ground=True))
    else:
        pixels = brighter(train.power, BRIGHT_DB, usual_peak(train.power)).sum()
    return float(pixels / len(train) * math.prod(train.grid.spacing_m) / train.grid.cell_m**2)


def _start_scales_m(config: Config, cell_m: float) -> list[float]:
    """Initial standard deviations along a Gaussian's axes, m."""
    smallest, first, _ = scales_m(config, cell_m)
    if not scattering_named(config.scattering).oriented:
        return [first] * 3
    return [max(share * first, min(smallest, first)) for share in _INITIAL_WIDTHS]


def share_dropped(config: Config, views: int) -> float:
    """Share of the Gaussians that a step drops, given the number of training views."""
    return max(config.dropout, min(_MAX_SHARE, (config.few_views / views) ** 2))


def dropped(
    count: int, share: float, seed: int, step: int | Int64[Tensor, " 1"], device: torch.device
) -> Bool[Tensor, " {count}"]:
    """Mask of the dropped Gaussians, a random share (0 to 1) of `count`.

    A hash of seed, step and row decides; the state of a generator would have to be copied to the device.
    """
    if isinstance(step, Tensor):  # wraps around by itself
        mixed = step * _signed(_STEP) + _signed(seed * _SEED) + _rows(count, device)
    else:
        mixed = _rows(count, device) + _signed(seed * _SEED + step * _STEP)
    for factor, shift in zip(_MIX, (30, 27), strict=True):
        mixed.bitwise_xor_(mixed >> shift).mul_(_signed(factor))
    first_kept = math.ceil(np.float32(share * 2**_BITS))  # an integer: others are rounded to torch's default dtype
    return (mixed >> 32).bitwise_and_(2**_BITS - 1) < first_kept


@kept_on_device(maxsize=4)
def _rows(count: int, device: torch.device) -> Int64[Tensor, " {count}"]:
    return torch.arange(count, device=device) * _signed(_STEP * _STEP)


def _signed(number: int) -> int:
    """The last 64 bits as a signed integer, torch's int64."""
    return (number + 2**63) % 2**64 - 2**63
