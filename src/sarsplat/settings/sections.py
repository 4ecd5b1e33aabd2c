"""Sections of the settings: records, most of which are optional.

Lengths are in resolution cells (`sarsplat.ImageGrid.cell_m`), so that settings suit targets of any size.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from sarsplat.errors import SarsplatError
from sarsplat.settings.kinds import (
    LEAST,
    Count,
    Iteration,
    NotNegative,
    Number,
    OpticalDepth,
    Positive,
    RaysPerPixel,
    Share,
)
from sarsplat.settings.record import Record


@dataclass(frozen=True)
class Rates(Record, prefix="rates."):
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
        Common parameters of all Gaussians' scattering laws.
    shift : float
        Shifts of measured images, resolution cells per step.
    ground : float
        Logarithms of γ⁰ of single places on the ground.
    nuisance : float
        Mean ground, noise floor, phase screens (rad), side lobes and logarithms of the gains of measured images.
    """

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
class Densification(Record, prefix="densification."):
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

    start: Iteration = 10_000
    stop: Iteration = 25_000
    every: Count = 500
    gradient: NotNegative = 0.003
    split_above: NotNegative = 0.33
    max_extent: NotNegative = 0.3
    min_scattering: NotNegative = 0.005
    max_gaussians: Count = 60_000


@dataclass(frozen=True)
class Relocation(Record, prefix="relocation."):
    """Moves of idle Gaussians to others, of which each takes over half.

    Parameters
    ----------
    rounds : int
        Number of rounds, evenly spaced; 0: none.
    until : float
        Time of the last round, as a share of all iterations.
    idle_share : float
        Share of all lit areas (the largest in any training view) that the idle Gaussians have together.
    alike_from : float
        Relative lit area of a cell's cube from which all count alike; below 1, hidden ones go. With pixel blocks only.
    """

    rounds: Iteration = 12
    until: Share = 0.75
    idle_share: Share = 0.004
    alike_from: Positive = 0.05


@dataclass(frozen=True)
class Smoothing(Record, prefix="smoothing."):
    """Moves and rotations of visible Gaussians towards the surface of their neighbours.

    Only for trainings that begin with blocks of pixels: images hardly tell the height inside of large surfaces.

    Parameters
    ----------
    rounds : int
        Number of rounds, evenly spaced over all iterations; 0: none.
    share : float
        Share of the distance to the plane, and of the angle to its normal, that a round removes.
    radius : float
        Maximum distance of neighbours, in resolution cells.
    thinner : float
        Share by which a round reduces the shortest standard deviation of the moved Gaussians.
    alike : float
        Share of the difference between a Gaussian's scattering and its neighbours' that a round removes, in images
        coarser than those given.
    collective : float
        Initial rate of collective moves of neighbours at full resolution, resolution cells per step, on each of two
        lattices; it falls to zero. 0: none, and no change of all scattering together (from `law_from` on) either.
    """

    rounds: Iteration = 40
    share: Share = 0.7
    radius: Positive = 3.0
    thinner: Annotated[float, Meta(ge=0, le=0.9)] = 0.04
    alike: Share = 1.0
    collective: NotNegative = 0.04


@dataclass(frozen=True)
class PointExtraction(Record, prefix="points."):
    """Extraction of a point cloud from the Gaussians.

    Parameters
    ----------
    method : str
        "rays": first returns of rays from the training views and from halfway between neighbouring ones;
        "centres": centres of the Gaussians.
    optical_depth : float
        Two-way optical depth of a first return ("rays") of targets that are learned at full resolution alone, or
        minimum κ of a Gaussian ("centres").
    smoothed_depth : float
        The optical depth of a first return ("rays") instead, where a training begins with blocks of pixels.
    power_share : float
        Share of the power that the strongest Gaussians, which are kept, return ("centres").
    voxel : float
        Side of voxels with one point each, in resolution cells.
    min_height : float
        Minimum height of points, in resolution cells; lower ones are ground.
    rays_per_pixel : float
        Rays per pixel spacing ("rays").
    seen_through : float
        Remove a point if more than this share of the views look through it: their first return is farther than `behind`
        behind it ("rays").
    behind : float
        Distance within which a first return confirms a point, in resolution cells ("rays").
    seen_by : int
        Remove a point unless this many views, or a fifth of them if that is fewer, confirm it ("rays"): speckle differs
        between views. 0: keep it.
    clusters : str
        "largest": keep only the largest cluster (DBSCAN); "bright": keep every cluster that is higher than a resolution
        cell and returns more than the brightest speckle of a cell of ground.
    cluster_radius : float or None
        Radius of neighbours ("largest") or side of cubes ("bright"), in resolution cells; None: keep all points.
    cluster_size : int
        Minimum number of neighbours of a point inside the largest cluster.
    """

    method: Literal["rays", "centres"] = "rays"
    optical_depth: Annotated[float, Meta(ge=0, le=40)] = 0.7
    smoothed_depth: OpticalDepth = 0.5
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
            raise SarsplatError("points.optical_depth is 0, at which no ray returns; give more, such as 0.6")


@dataclass(frozen=True)
class FlatGround(Record, prefix="ground."):
    """Ground at z = 0, or the dataset's terrain, on which rays end, with a learned γ⁰.

    Parameters
    ----------
    pitch : float
        Spacing of the lattice of γ⁰, in resolution cells; 0: uniform ground.
    std : float
        Prior standard deviation of the logarithm of a single place's γ⁰.
    from_images : bool
        Start at the median brightness of the images, place by place, such as of roads; otherwise uniform.
    """

    pitch: NotNegative = 3.0
    std: Positive = 1.0
    from_images: bool = False


@dataclass(frozen=True)
class Bounce(Record, prefix="bounce."):
    """Second bounce between target and level ground, which reflects like a mirror.

    Parameters
    ----------
    reflectivity : float
        Initial share of the power that the ground reflects like a mirror, 0 to 1; it is learned.
    """

    reflectivity: Share = 0.3


@dataclass(frozen=True)
class Surroundings(Record, prefix="surroundings."):
    """Further effects in measured images of a target on the ground (docs/concepts/measured-chips.md).

    Standard deviations are those of priors; 0 keeps the usual value.

    Parameters
    ----------
    noise_floor : float
        Initial additive power, in `Config.unit`, like `p_min` and every γ⁰.
    speckle_floor : float
        Power added to rendered and true images in the loss "speckle", in `Config.unit`: otherwise shadows without
        noise are likelier the darker they are rendered, without end, and surfaces are deformed for it.
    shift_std : float
        Prior standard deviation of an image's shift, in resolution cells.
    gain_std : float
        Prior standard deviation of the logarithm of an image's gain.
    side_lobes : float
        Initial power of the side lobes of bright scatterers, relative to those of the response (−35 dB Taylor for a
        response without any); 0: none.
    texture_looks : float
        Number of looks at which the texture, a factor between images and scene that neighbouring images share, differs
        from 1 by half as much as the one measured; 0: no texture.
    texture_reach_deg : float
        Difference of azimuth at which neighbouring images share 1/e of the texture, whatever the grazing angles.
    texture_width : float
        Standard deviation of the texture's smoothing, in resolution cells.
    texture_rounds : int
        Number of further estimates of the texture after the first, evenly from `texture_from` to the end.
    texture_from : float
        Time of the texture's first estimate, as a share of the iterations.
    azimuth_rounds : int
        Number of refinements of uncertain azimuths, evenly from `azimuth_from` to `azimuth_until`.
    azimuth_from : float
        Time of the first refinement of azimuths, as a share of all iterations.
    azimuth_until : float
        Time of the last refinement of azimuths, as a share of all iterations.
    """

    _gone: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("ground_pitch", "ground_std"), "ground is a plane now, so train again (settings: ground.pitch, ground.std)"
    )

    noise_floor: Positive = 0.05
    speckle_floor: NotNegative = 0.001
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
        _refuse_tiny(self, "shift_std", "gain_std", "texture_looks")


@dataclass(frozen=True)
class Turns(Record, prefix="turns."):
    """Refinement of uncertain axes and rates of rotation (`sarsplat.Turn`).

    Parameters
    ----------
    rounds : int
        Number of rounds, evenly spaced; 0: none.
    begin : float
        Time of the first round, as a share of all iterations.
    until : float
        Time of the last round, as a share of all iterations.
    """

    rounds: Iteration = 12
    begin: Share = 0.1
    until: Share = 0.9


@dataclass(frozen=True)
class Passes(Record, prefix="passes."):
    """Learning from interferometric stacks.

    Parameters
    ----------
    window : int
        Side of the square, in pixels, over which covariances of images and scene are averaged, after removing the phase
        of level ground: single looks would be taken for surfaces.
    elevation_only : float
        Share of the training in which centres only move in elevation, if all images have one direction: azimuth and
        range are known to a pixel, elevation is not.
    noise : float
        Initial power of the passes' noise, in units of the training mean, if the stacks do not give it.
    screen_std : float
        Prior standard deviation of the phase that atmosphere and unknown baselines add to each pass, rad: a constant,
        and slopes from the middle of images to their edges; 0: none.
    """

    window: Annotated[int, Meta(ge=1, le=99)] = 3
    elevation_only: Share = 1.0
    noise: Positive = 0.05
    screen_std: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window % 2 == 0:
            raise SarsplatError(f"passes.window is {self.window}; give an odd number of pixels, such as 3")
        _refuse_tiny(self, "screen_std")


def _refuse_tiny(record: Record, *names: str) -> None:
    """Raise for settings above 0 whose squares and reciprocals would leave float32."""
    for name in names:
        if 0 < (value := getattr(record, name)) < LEAST:
            raise SarsplatError(f"{record._prefix}{name} is {value:g}; give at least {LEAST:g}, or 0 to switch it off")
