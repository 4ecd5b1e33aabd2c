"""How a reconstruction is done: one frozen record, and the presets as data."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from sarsplat.errors import SarsplatError, shown
from sarsplat.gaussians import MIN_SCALE, SCATTERINGS


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates; `means` decays exponentially to `means_end`, the others tenfold over the second half."""

    means: float = 0.02  # m
    means_end: float = 0.001  # m
    quaternions: float = 0.01
    log_scales: float = 0.02
    log_optical_depth: float = 0.05
    scattering: float = 0.05  # what is the same in all directions
    directional_scattering: float = 0.01
    nuisance: float = 0.01  # ground, noise floor, shifts (m) and log gains


@dataclass(frozen=True)
class Densification:
    """Density control of 3D Gaussian splatting, with the paper's thresholds."""

    start: int
    stop: int
    every: int
    gradient: float  # mean |∂L/∂μ| on the planes, per half image width (normalised device coordinates, as 3DGS)
    split_above: float  # m: a larger Gaussian is split, a smaller one cloned
    largest: float  # share of the illuminated range beyond which a Gaussian is pruned
    least_scattering: float  # P·(1 − e^−κ) below which a Gaussian is pruned
    most: int  # Gaussians


@dataclass(frozen=True)
class PointExtraction:
    """How a point cloud is drawn from Gaussians."""

    method: Literal["rays", "centres"]
    optical_depth: float  # two-way depth at which a ray has returned ("rays"), or least κ of a centre ("centres")
    voxel: float  # m: one point in each
    least_height: float = 0.0  # m above the ground: lower points are the ground, or below it
    seen_through: int = 3  # a point is dropped when this many views have their return behind it ("rays") …
    behind: float = 0.1  # … by more than this, m
    cluster_radius: float | None = None  # DBSCAN ε, m, of which the largest cluster is kept; None: no clean-up
    cluster_size: int = 10


@dataclass(frozen=True)
class Surroundings:
    """What measured chips hold besides the target."""

    noise_floor: float  # initial additive power, in units of the training mean, as P_min and every γ⁰
    deviation_penalty: float  # nats per pixel, per m² of shift and squared log gain


_MOST = 100_000_000


def _require(fits: bool, name: str, value: object, allowed: str) -> None:
    if not fits:
        raise SarsplatError(f"{name} {shown(value)} does not do in a configuration; it must be {allowed}")


def _require_types(record: object) -> None:
    """Every field of a dataclass is of the type that it is declared with; a whole number will do for a float."""
    for name, declared in get_type_hints(type(record)).items():
        value = getattr(record, name)
        described = str(getattr(declared, "__name__", declared)) if not get_args(declared) else str(declared)
        _require(_is(value, declared), name, value, described.replace("typing.", ""))


def _is(value: object, declared: Any) -> bool:
    inner = get_args(declared)
    if get_origin(declared) is Literal:
        return value in inner
    if get_origin(declared) is UnionType:
        return any(_is(value, choice) for choice in inner)
    if get_origin(declared) is tuple:
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(_is, value, inner))
    if declared in (int, float):
        return isinstance(value, int | declared) and not isinstance(value, bool) and abs(value) < 1e300
    return isinstance(value, declared)


@dataclass(frozen=True)
class Config:
    """Everything a reconstruction depends on, besides the dataset."""

    preset: str
    iterations: int
    views_per_step: int
    gaussians: int
    initialisation: Literal["box", "hemisphere"]
    loss: Literal["amplitude", "speckle"]
    ssim_weight: float
    scattering: str  # a law of `SCATTERINGS`
    p_min: float  # γ⁰
    initial_scale: float  # m
    initial_optical_depth: float
    initial_scattering: float  # γ⁰
    scale_bounds: tuple[float, float]  # m
    most_optical_depth: float
    harmonics_degree: int
    harmonics_every: int  # iterations between degrees
    rays_per_pixel: float
    rates: Rates
    points: PointExtraction
    densification: Densification | None = None
    surroundings: Surroundings | None = None
    checkpoint_every: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        for record in (self, self.rates, self.points, self.densification, self.surroundings):
            if record is not None:
                _require_types(record)
        for name in ("iterations", "views_per_step", "gaussians", "harmonics_every", "checkpoint_every"):
            _require(1 <= (value := getattr(self, name)) <= _MOST, name, value, "1 or more")
        _require(self.scattering in SCATTERINGS, "scattering", self.scattering, f"one of {', '.join(SCATTERINGS)}")
        _require(0 <= self.seed < 2**63, "seed", self.seed, "0 or more, below 2^63")
        _require(self.harmonics_degree in (0, 1, 2, 3), "harmonics_degree", self.harmonics_degree, "0 to 3")
        for name in ("rays_per_pixel", "initial_scale", "initial_optical_depth", "most_optical_depth"):
            value = getattr(self, name)
            _require(0 < value < 1e6, name, value, "a positive number")
        for name in ("p_min", "ssim_weight", "initial_scattering"):
            value = getattr(self, name)
            _require(0 <= value < 1e6, name, value, "a number of at least 0")
        low, high = self.scale_bounds
        _require(
            MIN_SCALE <= low <= high <= 1e6, "scale_bounds", self.scale_bounds, f"a rising pair from {MIN_SCALE:g} m"
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Config:
        """Undo `as_dict`.

        Raises
        ------
        SarsplatError
            If a field is missing or unknown.
        """
        try:
            known = {f.name for f in fields(cls)}
            if set(data) != known:
                raise TypeError(f"fields {sorted(set(data) ^ known)} missing or unknown")
            nested = {
                "rates": Rates(**data["rates"]),
                "points": PointExtraction(**data["points"]),
                "densification": Densification(**data["densification"]) if data["densification"] else None,
                "surroundings": Surroundings(**data["surroundings"]) if data["surroundings"] else None,
                "scale_bounds": tuple(data["scale_bounds"]),
            }
            return cls(**{**data, **nested})
        except (TypeError, KeyError, AttributeError) as error:
            raise SarsplatError(
                f"the configuration does not fit this version ({shown(str(error))}); start the run again"
            ) from error


_DEFAULT = Config(
    preset="default",
    iterations=1000,
    views_per_step=8,
    gaussians=15_000,
    initialisation="box",
    loss="amplitude",
    ssim_weight=0.0,
    scattering="harmonics",
    p_min=0.03,
    initial_scale=0.08,
    initial_optical_depth=0.1,
    initial_scattering=0.5,
    scale_bounds=(0.01, 0.3),
    most_optical_depth=10.0,
    harmonics_degree=3,
    harmonics_every=200,
    rays_per_pixel=2.0,
    rates=Rates(),
    points=PointExtraction("rays", optical_depth=0.6, voxel=0.05),
)

PRESETS: dict[str, Config] = {
    # what measures best on noise-free images
    "default": _DEFAULT,
    # the paper's training, as far as it is stated (docs/paper-map.md)
    "paper": replace(
        _DEFAULT,
        preset="paper",
        iterations=30_000,
        views_per_step=1,
        initialisation="hemisphere",
        ssim_weight=0.2,
        p_min=0.0,
        harmonics_every=2500,
        rates=Rates(
            means=0.01,
            means_end=0.0005,
            log_scales=0.005,
            quaternions=0.001,
            scattering=0.01,
            directional_scattering=0.0005,
        ),
        densification=Densification(
            start=10_000,
            stop=25_000,
            every=500,
            gradient=0.003,
            split_above=0.1,
            largest=0.3,
            least_scattering=0.005,
            most=60_000,
        ),
        points=PointExtraction("centres", optical_depth=0.01, voxel=0.02),
        checkpoint_every=2500,
    ),
    # real chips: ground, noise floor, shift and gain of each chip, speckle likelihood. Large Gaussians average speckle;
    # glints are 20 dB above the ground, so the harmonics must travel far.
    "measured": replace(
        _DEFAULT,
        preset="measured",
        iterations=600,
        gaussians=12_000,
        loss="speckle",
        p_min=0.2,
        initial_scale=0.25,
        initial_scattering=1.0,
        scale_bounds=(0.2, 0.7),
        harmonics_every=50,
        rates=Rates(means=0.05, scattering=0.4, directional_scattering=0.4),
        points=PointExtraction(
            "rays", 0.7, voxel=0.1, least_height=0.5, behind=0.2, cluster_radius=0.3, cluster_size=10
        ),
        surroundings=Surroundings(
            noise_floor=0.05,
            deviation_penalty=0.01,
        ),
    ),
}
"""Known presets by name."""


def preset(name: str) -> Config:
    """The preset of that name.

    Raises
    ------
    SarsplatError
        If there is none.
    """
    if name not in PRESETS:
        raise SarsplatError(f"preset {name!r} is unknown; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]
