"""Sections of the settings: records that belong together, most of which are absent unless they are wanted.

Lengths are in resolution cells (`sarsplat.ImageGrid.cell_m`), so that settings suit a ship as they suit a tank.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from sarsplat.errors import SarsplatError
from sarsplat.settings.kinds import LEAST, Count, Iteration, NotNegative, Number, Positive, RaysPerPixel, Share
from sarsplat.settings.record import Record


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
class Smoothing(Record):
    """What is lit in each resolution cell moves and turns towards a plane through its neighbours.

    Only where the training begins with blocks of pixels: surfaces of many cells look alike from inside, at any height.

    Parameters
    ----------
    rounds : int
        How often, evenly spaced over all iterations; 0: never.
    share : float
        How far each time, of the distance to the plane and of the angle to its normal.
    radius : float
        How far neighbours are at most, in resolution cells.
    thinner : float
        By which share the shortest standard deviation of what moves shrinks each time.
    """

    _section: ClassVar[str] = "smoothing."

    rounds: Iteration = 40
    share: Share = 0.7
    radius: Positive = 3.0
    thinner: Annotated[float, Meta(ge=0, le=0.9)] = 0.04


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
    clusters : str
        "largest": keep only the largest cluster (DBSCAN); "bright": keep every cluster that is higher than a resolution
        cell and returns more than the brightest speckle of a cell of ground.
    cluster_radius : float or None
        Radius of neighbours ("largest") or side of cubes ("bright"), in resolution cells; None: keep all points.
    cluster_size : int
        Minimum number of neighbours of a point inside the largest cluster.
    """

    _section: ClassVar[str] = "points."

    method: Literal["rays", "centres"] = "rays"
    optical_depth: Annotated[float, Meta(ge=0, le=40)] = 0.7
    power_share: Share = 1.0
    voxel: Positive = 0.05
    min_height: Number = 0.0
    rays_per_pixel: RaysPerPixel = 10.0
    seen_through: Share = 0.17
    behind: NotNegative = 0.17
    seen_by: Iteration = 0
    clusters: Literal["largest", "bright"] = "largest"
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
    from_images : bool
        Whether places start as bright as half of the images show them, such as roads; otherwise all start alike.
    """

    _section: ClassVar[str] = "ground."

    pitch: NotNegative = 3.0
    std: Positive = 1.0
    from_images: bool = False


@dataclass(frozen=True)
class Bounce(Record):
    """Second bounce by way of the ground, which is level and reflects like a mirror, from target to ground and reverse.

    Parameters
    ----------
    reflectivity : float
        Share of the power that the ground reflects like a mirror, 0 to 1, at the start: it is learned.
    """

    _section: ClassVar[str] = "bounce."

    reflectivity: Share = 0.3


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
            if 0 < value < LEAST:  # squares and reciprocals of it would leave float32
                raise SarsplatError(f"surroundings.{name} is {value:g}; give at least {LEAST:g}, or 0 to switch it off")


@dataclass(frozen=True)
class Turns(Record):
    """How axes and rates of rotation that are uncertain are refined (`sarsplat.Turn`).

    Parameters
    ----------
    rounds : int
        How often, evenly spaced; 0: never.
    begin : float
        The first time, as a share of all iterations.
    until : float
        The last time.
    """

    _section: ClassVar[str] = "turns."

    rounds: Iteration = 12
    begin: Share = 0.1
    until: Share = 0.9


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
        if 0 < self.screen_std < LEAST:  # squares and reciprocals of it would leave float32
            raise SarsplatError(
                f"passes.screen_std is {self.screen_std:g}; give at least {LEAST:g} radians, or 0 to switch it off"
            )
