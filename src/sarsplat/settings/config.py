"""`Config`: all settings of a reconstruction, a frozen record; needs no torch.

Lengths are in resolution cells (`sarsplat.ImageGrid.cell_m`), so that settings suit a ship as they suit a tank.
"""

from __future__ import annotations

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

    before: ClassVar[Mapping[str, Any]] = {}
    """Settings of runs whose files do not have them, where these are not the defaults."""

    @classmethod
    def of_run(cls, settings: Mapping[str, Any], source: str) -> Self:
        """Those that a run's file holds, as the run was begun, maybe by an earlier version; errors as `from_dict`."""
        return cls.from_dict({**cls.before, **settings}, source)


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
    unit : str
        Unit of every γ⁰ in the settings, and of the noise floor: "image" is 1, with `surroundings` the mean of the
        training images; in "target", half of the pixels that stand out from the ground show less than 0.5.
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
    smoothing : Smoothing
        Moves of neighbours into common planes.
    ground : FlatGround or None
        Ground below the target; None: nothing.
    bounce : Bounce or None
        Second bounce by way of level ground; None: nothing returns that way.
    surroundings : Surroundings or None
        What measured images show besides target and ground; None: nothing.
    passes : Passes or None
        How covariances of interferometric stacks are learned from; None: from power alone.
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

    may_change: ClassVar[tuple[str, ...]] = (*AnyConfig.may_change, PointExtraction._section)
    before: ClassVar[Mapping[str, Any]] = {"smoothing": {"rounds": 0}}

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
            raise SarsplatError(
                "bounce is on, but ground is off, by way of which it returns; give ground on, or bounce off"
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
    """Refuse to resume a run with settings other than its own, unless the training does not depend on them."""
    free = begun.may_change
    for name, before, after in begun.changes(wanted):
        if not any(name == one or (one.endswith(".") and name.startswith(one)) for one in free):
            names = [f"{one}…" if one.endswith(".") else one for one in free]
            raise SarsplatError(
                f"{run} was started with {name} {shown(before)}, not {shown(after)}; resume it with the same settings, "
                f"except {', '.join(names[:-1])} and {names[-1]}, which may change"
            )
