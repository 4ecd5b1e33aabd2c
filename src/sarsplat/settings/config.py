"""`Config`: all settings of a reconstruction, a frozen record; needs no torch.

Lengths are in resolution cells (`sarsplat.ImageGrid.cell_m`), so that settings suit a ship as they suit a tank.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from msgspec import Meta

from sarsplat.errors import SarsplatError, shown
from sarsplat.names import SCATTERINGS
from sarsplat.settings.record import Record

if TYPE_CHECKING:
    from sarsplat.data.header import Box

Count = Annotated[int, Meta(ge=1, le=100_000_000)]
Iteration = Annotated[int, Meta(ge=0, le=100_000_000)]
Degree = Annotated[int, Meta(ge=0, le=3)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_LEAST = 1e-6
Positive = Annotated[float, Meta(ge=_LEAST, le=1e6)]
NotNegative = Annotated[float, Meta(ge=0, le=1e6)]
OpticalDepth = Annotated[float, Meta(ge=1e-3, le=40)]
"""Up to `sarsplat.gaussians.MAX_OPTICAL_DEPTH`."""

RaysPerPixel = Annotated[float, Meta(ge=0.01, le=1000)]
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Share = Annotated[float, Meta(ge=0, le=1)]

DEFAULT_METHOD = "sar-gs"
"""The method where none is named."""

OWN_LOOP = "own loop"
"""Instead of a preset: Gaussians that no training of ours has made (`Run.from_gaussians`)."""

SCATTERERS = 2.5
"""Of a target that a pixel of a sample sees at a time: on MSTAR, chosen by training chips that were left out."""


class AnyConfig(Record):
    """Base of every method's settings: what its loop and its run need to know."""

    iterations: int
    checkpoint_every: int
    views_per_step: int
    seed: int

    may_change: ClassVar[tuple[str, ...]] = ("iterations", "checkpoint_every")
    """What a training does not depend on, so that it may differ when a run is resumed; with a dot, a section."""


@dataclass(frozen=True)
class Rates(Record):
    """Learning rates of Adam.

    Those of the means decay exponentially, the others tenfold over the second half of the training.

    Parameters
    ----------
    means : float
        Centres at the start, resolution cells per step.
    means_end : float
        Centres at the end, resolution cells per step.
    quaternions : float
        Orientations.
    log_scales : float
        Logarithms of the standard deviations.
    log_optical_depth : float
        Logarithms of the optical depths.
    scattering : float
        Isotropic part of the scattering.
    directional_scattering : float
        Directional part of the scattering.
    law : float
        What all Gaussians' laws of scattering have in common.
    shift : float
        Shifts of measured images, resolution cells per step.
    ground : float
        Logarithms of γ⁰ of single places on the ground.
    nuisance : float
        Ground as a whole, noise floor, phase screens (rad), side lobes and logarithms of the gains of measured images.
    """

    _section: ClassVar[str] = "rates."

    means: Positive = 0.15
    means_end: Positive = 0.0033
    quaternions: NotNegative = 0.02
    log_scales: NotNegative = 0.05
    log_optical_depth: NotNegative = 0.05
    scattering: NotNegative = 0.08
    directional_scattering: NotNegative = 0.08
    law: NotNegative = 0.04
    shift: NotNegative = 0.032
    ground: NotNegative = 0.02
    nuisance: NotNegative = 0.01


@dataclass(frozen=True)
class Densification(Record):
    """Density control of 3D Gaussian splatting (splitting, cloning, pruning) with the paper's thresholds.

    Parameters
    ----------
    start : int
        First iteration.
    stop : int
        Last iteration.
    every : int
        Iterations between two rounds.
    gradient : float
        Gaussians with a larger mean |∂L/∂μ| on the planes, per half image width, are split or cloned.
    split_above : float
        Larger Gaussians are split, smaller ones cloned, in resolution cells.
    max_extent : float
        Larger Gaussians are pruned, as a fraction of the illuminated range.
    min_scattering : float
        Gaussians with a smaller P·(1 − e^−κ) are pruned.
    max_gaussians : int
        Maximum number of Gaussians.
    """

    _section: ClassVar[str] = "densification."

    start: Iteration = 10_000
    stop: Iteration = 25_000
    every: Count = 500
    gradient: NotNegative = 0.003
    split_above: NotNegative = 0.33
    max_extent: NotNegative = 0.3
    min_scattering: NotNegative = 0.005
    max_gaussians: Count = 60_000


@dataclass(frozen=True)
class Relocation(Record):
    """Idle Gaussians move to where something returns: each takes over half of a strong one.

    Parameters
    ----------
    rounds : int
        How often, evenly spaced; 0: never.
    until : float
        When the last round is, as a share of all iterations.
    idle_share : float
        Idle are the weakest Gaussians that together have at most this share of all cross-sections; of each the largest
        in any training view counts.
    """

    _section: ClassVar[str] = "relocation."

    rounds: Iteration = 12
    until: Share = 0.75
    idle_share: Share = 0.01


@dataclass(frozen=True)
class PointExtraction(Record):
    """How a point cloud is extracted from the Gaussians.

    Parameters
    ----------
    method : str
        "rays": first returns of rays from the training views and from halfway between neighbouring ones;
        "centres": centres of the Gaussians.
    optical_depth : float
        Two-way optical depth of a first return ("rays"), or smallest κ of a Gaussian ("centres").
    power_share : float
        Leave out the weakest Gaussians, which together return the rest of the power ("centres").
    voxel : float
        Keep one point in each voxel of this side, in resolution cells.
    min_height : float
        Lower points are treated as ground and removed, in resolution cells.
    rays_per_pixel : float
        Rays per pixel spacing ("rays").
    seen_through : float
        Remove a point if this share of the views have their first return behind it ("rays") …
    behind : float
        … by more than this distance, in resolution cells.
    seen_by : int
        Remove a point unless this many of the views, or a fifth of them if that is fewer, have their first return
        within this distance of it ("rays"): each view takes speckle for something else. 0: keep it.
    cluster_radius : float or None
        Keep only the largest cluster (DBSCAN with this ε, in resolution cells); None: keep all points.
    cluster_size : int
        Minimum number of neighbours of a point inside a cluster.
    """

    _section: ClassVar[str] = "points."

    method: Literal["rays", "centres"] = "rays"
    optical_depth: Annotated[float, Meta(ge=0, le=40)] = 0.7
    power_share: Share = 1.0
    voxel: Positive = 0.067
    min_height: Number = 0.0
    rays_per_pixel: RaysPerPixel = 10.0
    seen_through: Share = 0.17
    behind: NotNegative = 0.17
    seen_by: Iteration = 0
    cluster_radius: Positive | None = None
    cluster_size: Count = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method == "rays" and self.optical_depth == 0:
            raise SarsplatError("points.optical_depth is 0, which no ray returns at; give more, as 0.6")


@dataclass(frozen=True)
class FlatGround(Record):
    """Ground at z = 0, or the dataset's terrain, on which rays end: it has a γ⁰, and shadow.

    Parameters
    ----------
    pitch : float
        Distance of the places that have a γ⁰ of their own, in resolution cells; 0: all of it has the same.
    std : float
        Standard deviation of the logarithm of a single place's γ⁰, as expected before the images are seen.
    """

    _section: ClassVar[str] = "ground."

    pitch: NotNegative = 3.0
    std: Positive = 1.0


@dataclass(frozen=True)
class Surroundings(Record):
    """What else is modelled in measured images of a target on the ground (docs/concepts/measured-chips.md).

    Standard deviations say how far something is expected to be from its usual value, before the images are seen; with 0
    it keeps that value.

    Parameters
    ----------
    noise_floor : float
        Additive power at the start, in units of the training mean, like `p_min` and every γ⁰.
    shift_std : float
        Standard deviation of an image's shift, in resolution cells.
    gain_std : float
        Standard deviation of the logarithm of an image's gain.
    side_lobes : float
        Power of the side lobes of bright scatterers at the start, relative to those of the response (−35 dB Taylor
        where that has none); 0: none.
    texture_looks : float
        The factor between images and scene that is shared by neighbouring images: how many looks it takes to believe in
        one that differs from 1 by half of what they show; 0: there is none.
    texture_reach_deg : float
        Difference of azimuth at which it is shared to 1/e, whatever the grazing angles.
    texture_width : float
        Standard deviation of the window through which it is seen, in resolution cells.
    texture_rounds : int
        How often it is estimated anew, evenly and the last time at the end, after the first time …
    texture_from : float
        … at this share of the iterations.
    azimuth_rounds : int
        How often uncertain azimuths of training images are refined, evenly spaced …
    azimuth_from : float
        … from this share of all iterations on …
    azimuth_until : float
        … to this one.
    """

    _section: ClassVar[str] = "surroundings."
    _gone: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("ground_pitch", "ground_std"),
        "ground is a plane now, so train again (settings: ground.pitch, ground.std)",
    )

    noise_floor: Positive = 0.05
    shift_std: NotNegative = 1.0
    gain_std: NotNegative = 1.0
    side_lobes: NotNegative = 1.0
    texture_looks: NotNegative = 2.0
    texture_reach_deg: Positive = 15.0
    texture_width: Positive = 0.4
    texture_rounds: Count = 6
    texture_from: Share = 0.25
    azimuth_rounds: Iteration = 8
    azimuth_from: Share = 0.3
    azimuth_until: Share = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("shift_std", "gain_std", "texture_looks"):
            value = getattr(self, name)
            if 0 < value < _LEAST:  # squares and reciprocals of it would leave float32
                raise SarsplatError(
                    f"surroundings.{name} is {value:g}; give at least {_LEAST:g}, or 0 to switch it off"
                )


@dataclass(frozen=True)
class Passes(Record):
    """How a scene is learned from interferometric stacks.

    Parameters
    ----------
    window : int
        Side of the square, in pixels, over which covariances are averaged, those of the images and those of the scene,
        after the phase of level ground is taken out: single looks would be taken for surfaces.
    elevation_only : float
        Share of the training in which centres move in elevation alone, where all images have one direction: what lies
        where in the images is known to a pixel, and what is higher is not.
    noise : float
        Power of the passes' noise at the start, in units of the training mean, where the stacks do not say.
    screen_std : float
        Standard deviation of what atmosphere and unknown baselines add to the phases of each pass, rad: a constant, and
        slopes from the middle of images to their edges; 0: nothing.
    """

    _section: ClassVar[str] = "passes."

    window: Annotated[int, Meta(ge=1, le=99)] = 3
    elevation_only: Share = 1.0
    noise: Positive = 0.05
    screen_std: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window % 2 == 0:
            raise SarsplatError(f"passes.window is {self.window}; give an odd number of pixels, such as 3")
        if 0 < self.screen_std < _LEAST:  # squares and reciprocals of it would leave float32
            raise SarsplatError(
                f"passes.screen_std is {self.screen_std:g}; give at least {_LEAST:g} radians, or 0 to switch it off"
            )


@dataclass(frozen=True)
class Config(AnyConfig):
    """Everything a reconstruction depends on, besides the dataset; the defaults are the preset `default`.

    Parameters
    ----------
    preset : str
        Name of the preset these settings were derived from; for information only.
    iterations : int
        Training steps.
    views_per_step : int
        Images used in one step.
    gaussians : int or None
        Gaussians at the start; None: as many as the next two say.
    gaussians_per_cell : float
        Gaussians for each resolution cell that the target covers in a training image, divided by f³ᐟ² where the
        training begins with blocks of f × f pixels.
    fewest_gaussians : int
        At least so many, where `gaussians` is None.
    coarsest : int
        Side of the blocks of pixels over which images are averaged at first, in pixels; half of it is next, and so on.
        Powers of two, and no more than leave 20 resolution cells across the target: small ones are looked at as they
        are. 1: so are all.
    tiles : int
        Tiles along each side of the scene: from images of smaller blocks than so many pixels on, each is learned by
        itself, in the memory that it takes. 1: the scene is learned whole.
    target_box : tuple of float or None
        Lower and upper corner (x, y, z, x, y, z) of the box in which the target is looked for, m; None: the dataset's,
        or what the images tell.
    initialisation : str
        Start inside the box derived from the images ("box"), or on the paper's hemisphere ("hemisphere").
    loss : str
        "amplitude": L1 and SSIM of amplitudes; "speckle": likelihood of single-look speckle; or another of `LOSSES`.
    ssim_weight : float
        Weight of SSIM in the loss on amplitudes; L1 has the rest.
    total_power : float
        Weight that "speckle" gives, where nothing surrounds the target, to the squared relative difference between the
        total powers of rendered and true images: otherwise glints, smoothed with the speckle, come out too dark.
    scattering : str
        Scattering law: "harmonics", "normal-lobes", or another that is registered.
    p_min : float
        Smallest γ⁰ of a Gaussian.
    scattering_penalty : float
        Weight of differences between the Gaussians' scattering, in units of the loss of black images, or, with a
        likelihood, in nats per pixel. Most materials scatter the same: a thin layer that scatters strongly looks like
        an opaque one, and costs more.
    common_law : bool
        Whether all Gaussians have in common what their law of scattering says: of "normal-lobes" the exponent, which
        starts as 2. Otherwise each has its own.
    law_from : float
        That is learned from this share on of the iterations: as long as surfaces have no shape, any law would do.
    law_penalty : float
        Weight of its squared distance from its start, in the units of `scattering_penalty`; of an exponent that is the
        logarithm's.
    initial_scale : float
        Standard deviation of a Gaussian at the start, in resolution cells.
    initial_optical_depth : float
        Two-way peak optical depth of a Gaussian at the start.
    initial_scattering : float
        γ⁰ of a Gaussian at the start, its mean over all directions.
    scale_bounds : tuple of float
        Smallest and largest standard deviation of a Gaussian, in resolution cells; the largest times f¹ᐟ⁶ where the
        training begins with blocks of f × f pixels.
    margin : float
        How far centres may leave the space that the images bound, in resolution cells.
    max_optical_depth : float
        Largest two-way peak optical depth of a Gaussian.
    harmonics_degree : int
        Highest degree of the spherical harmonics.
    harmonics_every : int
        Iterations after which the next degree is added.
    views_per_coefficient : float
        The degree stays so low that there are more training views than this for each coefficient of the harmonics.
    directional_std : float or None
        Standard deviation of each coefficient of the harmonics above degree 0, relative to a Gaussian's γ⁰, as expected
        before the images are seen; None: all are equally likely.
    sparsity : float
        How strongly Gaussians are expected to be empty before the images are seen, nats: one of optical depth κ costs
        ln(1 + κ/0.05) of them.
    dropout : float
        Share of the Gaussians left out of each step, by chance; the others make up for their optical depth.
    few_views : float
        The same where that is more: the square of this number by the number of training views, and at most 0.4.
    rays_per_pixel : float
        Rays per pixel spacing; more are more accurate and slower.
    fine_rays_per_pixel : float
        The same towards the end …
    fine_from : float
        … from this share on of the iterations that look at the images themselves.
    rates : Rates
        Learning rates.
    points : PointExtraction
        How the point cloud is extracted.
    densification : Densification or None
        Density control; None: the number of Gaussians is fixed.
    relocation : Relocation
        Moves of idle Gaussians.
    ground : FlatGround or None
        Ground below the target; None: nothing.
    surroundings : Surroundings or None
        What measured images show besides target and ground; None: nothing.
    passes : Passes or None
        How covariances of interferometric stacks are learned from; None: from power alone.
    checkpoint_every : int
        Iterations between two checkpoints.
    seed : int
        Random seed.

    Raises
    ------
    SarsplatError
        If a value has the wrong type or is outside its range.
    """

    may_change: ClassVar[tuple[str, ...]] = (*AnyConfig.may_change, PointExtraction._section)

    preset: str = "default"
    iterations: Count = 900
    views_per_step: Count = 4
    gaussians: Count | None = None
    gaussians_per_cell: Positive = 36.0
    fewest_gaussians: Count = 100
    coarsest: Count = 8
    tiles: Count = 1
    target_box: tuple[Number, Number, Number, Number, Number, Number] | None = None
    initialisation: Literal["box", "hemisphere"] = "box"
    loss: str = "amplitude"
    ssim_weight: NotNegative = 0.0
    total_power: NotNegative = 0.0
    scattering: str = "normal-lobes"
    p_min: NotNegative = 0.03
    scattering_penalty: NotNegative = 0.03
    common_law: bool = True
    law_from: Share = 0.4
    law_penalty: NotNegative = 0.005
    initial_scale: Positive = 0.2
    initial_optical_depth: OpticalDepth = 0.5
    initial_scattering: NotNegative = 0.5
    scale_bounds: tuple[Positive, Positive] = (0.067, 0.5)
    margin: NotNegative = 0.67
    max_optical_depth: OpticalDepth = 10.0
    harmonics_degree: Degree = 3
    harmonics_every: Count = 200
    views_per_coefficient: NotNegative = 0.0
    directional_std: Positive | None = None
    sparsity: NotNegative = 0.0
    dropout: Annotated[float, Meta(ge=0, le=0.9)] = 0.0
    few_views: NotNegative = 4.8
    rays_per_pixel: RaysPerPixel = 2.0
    fine_rays_per_pixel: RaysPerPixel = 4.0
    fine_from: Share = 0.5
    rates: Rates = Rates()
    points: PointExtraction = PointExtraction()
    densification: Densification | None = None
    relocation: Relocation = Relocation()
    ground: FlatGround | None = None
    surroundings: Surroundings | None = None
    passes: Passes | None = None
    checkpoint_every: Count = 500
    seed: Seed = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scattering not in SCATTERINGS:
            raise SarsplatError(
                f"scattering is {shown(self.scattering)}; it must be one of {', '.join(SCATTERINGS)}, or a law that is "
                "registered first (sarsplat.gaussians.register_scattering)"
            )
        if self.coarsest & (self.coarsest - 1):
            raise SarsplatError(f"coarsest is {self.coarsest}; give a power of two, such as 1, 2, 4 or 8")
        if self.box_m is not None and not all(low < high for low, high in zip(*self.box_m, strict=True)):
            raise SarsplatError(
                f"target_box is {shown(self.target_box)}; give the lower corner (x, y, z) and then the upper one, m"
            )
        if self.scale_bounds[0] > self.scale_bounds[1]:
            raise SarsplatError(f"scale_bounds is {shown(self.scale_bounds)}; give the smaller one first")
        if self.directional_std is not None and self.scattering != "harmonics":
            raise SarsplatError(
                f"directional_std is {shown(self.directional_std)}, but scattering is {self.scattering}; give none, or "
                "harmonics"
            )

    @property
    def box_m(self) -> Box | None:
        """Corners of `target_box`."""
        return None if self.target_box is None else (self.target_box[:3], self.target_box[3:])


def refuse_other_settings(run: Path, begun: AnyConfig, wanted: AnyConfig) -> None:
    """Refuse to resume a run with settings other than its own, unless the training does not depend on them.

    Raises
    ------
    SarsplatError
        If another setting differs; it is named, with both values.
    """
    free = begun.may_change
    for name, before, after in begun.changes(wanted):
        if not any(name == one or (one.endswith(".") and name.startswith(one)) for one in free):
            names = [f"{one}…" if one.endswith(".") else one for one in free]
            raise SarsplatError(
                f"{run} was started with {name} {shown(before)}, not {shown(after)}; resume it with the same settings, "
                f"except {', '.join(names[:-1])} and {names[-1]}, which may change"
            )
