"""`Config`: all settings of a reconstruction, a frozen record; needs no torch.

Lengths are in resolution cells (`sarsplat.ImageGrid.cell_m`), so that settings suit targets of any size.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from msgspec import Meta

from sarsplat.errors import SarsplatError, shown
from sarsplat.names import SCATTERINGS
from sarsplat.settings.kinds import (
    Count,
    Degree,
    NotNegative,
    Number,
    OpticalDepth,
    Positive,
    RaysPerPixel,
    Seed,
    Share,
)
from sarsplat.settings.record import Record
from sarsplat.settings.sections import (
    Bounce,
    Densification,
    FlatGround,
    Passes,
    PointExtraction,
    Rates,
    Relocation,
    Smoothing,
    Surroundings,
    Turns,
)

if TYPE_CHECKING:
    from sarsplat.data.header import Box

DEFAULT_METHOD = "sar-gs"
"""Default method."""

OWN_LOOP = "own loop"
"""Name in place of a preset, of Gaussians from elsewhere (`Run.from_gaussians`)."""

SCATTERERS = 2.5
"""Default mean number of a target's scatterers in a pixel of a sample, fitted to held-out training chips of MSTAR."""


class AnyConfig(Record):
    """Base of every method's settings: those that its loop and its run need."""

    iterations: int
    checkpoint_every: int
    views_per_step: int
    seed: int

    may_change: ClassVar[tuple[str, ...]] = ("iterations", "checkpoint_every")
    """Settings (with a dot: sections) that may change when a run is resumed: training does not depend on them."""

    before: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Values of sections' settings missing in older files, if they differ from the defaults."""

    @classmethod
    def of_run(cls, settings: Mapping[str, Any], source: str) -> Self:
        """Read the settings of a run's file, maybe of an earlier version; errors as `from_dict`."""
        given = {key: getattr(cls, key) and {} for key in cls.before} | {**settings}  # absent sections: None stays off
        older = {key: {**old, **given[key]} for key, old in cls.before.items() if isinstance(given[key], Mapping)}
        return cls.from_dict({**settings, **older}, source)


@dataclass(frozen=True)
class Config(AnyConfig):
    """All settings of a reconstruction; the defaults are the preset `default`.

    Parameters
    ----------
    preset : str
        Name of the preset these settings were derived from; for information only.
    iterations : int
        Training steps.
    views_per_step : int
        Images used in one step.
    gaussians : int or None
        Gaussians at the start; None: by `gaussians_per_cell` and `fewest_gaussians`.
    gaussians_per_cell : float
        Gaussians for each resolution cell that the target covers in a training image, divided by f³ᐟ² if the training
        begins with blocks of f × f pixels.
    fewest_gaussians : int
        Minimum number of Gaussians if `gaussians` is None.
    coarsest : int
        Largest side of the blocks of pixels over which images are averaged at first, a power of two; it is halved
        step by step to 1. Blocks leave at least 20 resolution cells across the target. 1: images are never averaged.
    tiles : int
        Tiles along each side of the scene, learned one by one to save memory, as soon as blocks of pixels are smaller
        than this number. 1: no tiles.
    target_box : tuple of float or None
        Lower and upper corner (x, y, z, x, y, z) of the target's box, m; None: the dataset's, or one found in the
        images.
    initialisation : str
        Start inside the box derived from the images ("box"), or on the paper's hemisphere ("hemisphere").
    loss : str
        "amplitude": L1 and SSIM of amplitudes; "speckle": likelihood of single-look speckle; or another of `LOSSES`.
    ssim_weight : float
        Weight of SSIM in the loss on amplitudes; L1 has the rest.
    total_power : float
        Weight in "speckle", for targets without surroundings, of the squared relative difference of total powers of
        rendered and true images: without it, glints are too dark.
    scattering : str
        Scattering law: "harmonics", "normal-lobes", or another that is registered.
    p_min : float
        Minimum γ⁰ of a Gaussian.
    unit : str
        Unit of every γ⁰ in the settings, and of the noise floor: "target": twice the median γ⁰ of the pixels above the
        ground; "image": the mean of the training images with `surroundings` or for stacks, otherwise a power of ten
        about as large as "target", 1 for calibrated images.
    scattering_penalty : float
        Weight of differences between the scattering of neighbours (in cubes of 6 and 24 resolution cells), in units of
        the loss of black images, or, with a likelihood, in nats per pixel. It favours opaque surfaces over thin layers.
    common_law : bool
        Share the common parameters of the scattering law between all Gaussians: of "normal-lobes" the exponent, which
        starts as 2.
    law_from : float
        Share of the iterations from which on common parameters and bounce are learned; before, surfaces have no shape.
    law_penalty : float
        Weight of the squared distance of the common parameters (of an exponent, its logarithm) from their start, in the
        units of `scattering_penalty`.
    initial_scale : float
        Standard deviation of a Gaussian at the start, in resolution cells.
    initial_optical_depth : float
        Two-way peak optical depth of a Gaussian at the start.
    initial_scattering : float
        γ⁰ of a Gaussian at the start, its mean over all directions; in images of a target alone, a factor on the γ⁰
        with which the first Gaussians would return their power, at most 1, but at least twice `p_min`.
    scale_bounds : tuple of float
        Minimum and maximum standard deviation of a Gaussian, in resolution cells; the maximum times f¹ᐟ⁶ if the
        training begins with blocks of f × f pixels.
    margin : float
        Distance that centres may be outside of the target's region, in resolution cells.
    max_optical_depth : float
        Maximum two-way peak optical depth of a Gaussian.
    harmonics_degree : int
        Highest degree of the spherical harmonics.
    harmonics_every : int
        Iterations after which the next degree is added.
    views_per_coefficient : float
        Minimum number of training views per coefficient of the harmonics, which limits the degree.
    directional_std : float or None
        Prior standard deviation of each coefficient of the harmonics above degree 0, relative to a Gaussian's γ⁰; None:
        no prior.
    sparsity : float
        Weight of the prior for empty Gaussians, nats: optical depth κ costs `sparsity`·ln(1 + κ/0.05).
    dropout : float
        Share of random Gaussians left out of each step; the others compensate for their optical depth.
    few_views : float
        Dropout is at least the square of this number over the number of training views, up to 0.4.
    rays_per_pixel : float
        Rays per pixel spacing; more are more accurate and slower.
    fine_rays_per_pixel : float
        Rays per pixel spacing after `fine_from`.
    fine_from : float
        Share of the iterations on full-resolution images from which on `fine_rays_per_pixel` are used.
    rates : Rates
        Learning rates.
    points : PointExtraction
        Extraction of the point cloud.
    densification : Densification or None
        Density control; None: the number of Gaussians is fixed.
    relocation : Relocation
        Moves of idle Gaussians.
    smoothing : Smoothing
        Moves of neighbours into common planes.
    ground : FlatGround or None
        Ground below the target; None: no ground.
    bounce : Bounce or None
        Second bounce by way of level ground; None: no second bounce.
    surroundings : Surroundings or None
        Noise, shifts, gains, side lobes and texture of measured images; None: none of them.
    passes : Passes or None
        Learning from covariances of interferometric stacks; None: from power alone.
    turns : Turns
        Refinement of uncertain rotations of a target aloft.
    evidence : str
        Measurements from which "auto" chose these settings; for information only.
    checkpoint_every : int
        Iterations between two checkpoints.
    seed : int
        Random seed.

    Raises
    ------
    SarsplatError
        If a value has the wrong type or is outside its range.
    """

    may_change: ClassVar[tuple[str, ...]] = (*AnyConfig.may_change, PointExtraction._prefix)
    before: ClassVar = {"smoothing": {"rounds": 0, "alike": 0, "collective": 0}, "surroundings": {"speckle_floor": 0}}

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
    unit: Literal["image", "target"] = "image"
    scattering_penalty: NotNegative = 0.03
    common_law: bool = True
    law_from: Share = 0.3
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
    smoothing: Smoothing = Smoothing()
    ground: FlatGround | None = None
    bounce: Bounce | None = None
    surroundings: Surroundings | None = None
    passes: Passes | None = None
    turns: Turns = Turns()
    evidence: str = ""
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
        if self.bounce is not None and self.ground is None:
            raise SarsplatError("bounce is on, but needs ground, which is off; switch ground on, or bounce off")
        if self.scale_bounds[0] > self.scale_bounds[1]:
            raise SarsplatError(f"scale_bounds is {shown(self.scale_bounds)}; give the smaller one first")
        if self.directional_std is not None and self.scattering != "harmonics":
            raise SarsplatError(
                f"directional_std is {shown(self.directional_std)}, but scattering is {self.scattering}; give none, or "
                "harmonics"
            )

    @property
    def box_m(self) -> "Box | None":
        """Corners of `target_box`."""
        return None if self.target_box is None else (self.target_box[:3], self.target_box[3:])


def refuse_other_settings(run: Path, begun: AnyConfig, wanted: AnyConfig) -> None:
    """Raise if a run is resumed with other settings than its own, unless training does not depend on them."""
    free = begun.may_change
    for name, before, after in begun.changes(wanted):
        if not any(name == one or (one.endswith(".") and name.startswith(one)) for one in free):
            names = [f"{one}…" if one.endswith(".") else one for one in free]
            raise SarsplatError(
                f"{run} was started with {name} {shown(before)}, not {shown(after)}; resume it with the same settings, "
                f"except {', '.join(names[:-1])} and {names[-1]}, which may change"
            )
