"""Groups of options of `sarsplat simulate`, each with the views, pixels, ground or stack that it describes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sarsplat.cli.arguments import (
    Angles,
    Folder,
    Group,
    Lengths,
    Metres,
    OptionalCount,
    OptionalFile,
    OptionalNumber,
    TargetBox,
    exclude,
    heights,
    one_of,
    option_group,
    pair,
    require,
    require_count,
    views_from,
)
from sarsplat.errors import SarsplatError
from sarsplat.names import RadarSide, Simulator, TargetName

if TYPE_CHECKING:
    from sarsplat.geometry import ImageGrid, Stack, Terrain, View

X_BAND_M = 0.031
"""Default wavelength, m."""

_MOST_FRAMES = 10_000
_VILLAGE_PIXELS = 256  # on a side: a handful of houses

Split = tuple["View", str]
"""A view and the name of its set."""
Raster = tuple[Angles, Angles, Angles]
"""Typed azimuths, grazing angles and incidence angles."""
Decibels = Annotated[float, tyro.conf.arg(metavar="DB")]
Law = Annotated[tuple[float, float] | tuple[float, float, float], tyro.conf.arg(metavar="FLOOR LOBE [EXPONENT]")]


@option_group
class Target:
    target: Annotated[TargetName | None, one_of(TargetName)] = None
    """A built-in target: a vehicle, one of the paper's buildings, a satellite or an aircraft (with --isar), or a
    village, .64 as wide as the images (256 pixels unless others are given), of houses drawn by --seed."""
    mesh: OptionalFile = None
    """A mesh file instead: metres, +x nose, +y left, +z up, ground at z = 0 but for --isar."""
    scale: float = 1.0
    """Factor on the target's size, such as 0.001 for a mesh in millimetres."""
    recentre: bool = False
    """Bring the middle of the target above the origin, where images are centred, and its lowest place to z = 0, such as
    one in map coordinates; with --isar its middle to the origin."""
    law: Law = (0.1, 0.9)
    """γ⁰ (linear) of the target's surface: FLOOR + LOBE·|cos i|^EXPONENT (default: 2), with i the angle between its
    normal and the radar. Constant: 1 0. Lambert: 0 1 1."""
    reflectivity: Decibels = 0.0
    """Draw a factor on γ⁰ for every connected part of the mesh, log-normally, with this standard deviation."""
    target_box: TargetBox = None
    """Lower and upper corner of the box in which reconstructions look for the target, m. Without it, they derive it
    from the images."""


@option_group
class Views:
    protocol: Literal["paper", "mstar"] = "paper"
    """Views and pixels: 24 training + 48 test views at 15, 45, 75° incidence (paper), or 36 + 72 at 17 and 15°
    grazing (mstar)."""
    azimuth: Angles = ()
    """Training azimuths, instead of the protocol's: degrees or start:stop:step (stop excluded), e.g. 0:360:15."""
    grazing: Angles = ()
    """Training grazing angles, degrees, between 0 and 90."""
    incidence: Angles = ()
    """Incidence angles (90° − grazing), instead of grazing angles."""
    random_views: OptionalCount = None
    """Number of random training views instead, between the lowest and the highest of the grazing angles (default: the
    protocol's)."""
    tilt: float = 0.0
    """Angle by which the azimuth axis of all images rises above the level one, degrees: of a radar that squints, climbs
    or dives."""
    side: RadarSide = "right"
    """Side of its flight on which the radar looks."""

    @property
    def raster(self) -> Raster:
        """Typed training angles."""
        return self.azimuth, self.grazing, self.incidence

    @property
    def of_protocol(self) -> list[Split]:
        """Views of the protocol."""
        from sarsplat.scenes import mstar_views, paper_views

        return paper_views() if self.protocol == "paper" else mstar_views()

    def splits(self, tests: TestViews, seed: int) -> list[Split]:
        """Return all views: those of the protocol if no angles were given; no test view is a training view."""
        theirs = self.of_protocol
        if self.random_views is not None:
            train = self._random(self.random_views, seed)
        elif any(self.raster):
            train = views_from(*self.raster)
        else:
            require("--azimuth", tests.angles)
            return self._posed(theirs)
        trained = {_direction(view) for view in train}
        test = tests.splits(theirs, self.raster)
        unseen = [(view, split) for view, split in test if _direction(view) not in trained]
        if test and not unseen:
            raise SarsplatError(f"all {len(test)} test views are training views; choose others with --test-azimuth")
        return self._posed([*((view, "train") for view in train), *unseen])

    def _posed(self, views: list[Split]) -> list[Split]:
        """Return the views with the tilt and side of the radar."""
        return [(replace(view, tilt_deg=self.tilt, side=self.side), split) for view, split in views]

    def _random(self, count: int, seed: int) -> list[View]:
        from sarsplat.scenes.protocols import random_views

        exclude("random-views", "draws the azimuths", {"azimuth": self.azimuth})
        if self.grazing or self.incidence:
            limits = views_from(("0",), self.grazing, self.incidence)
        else:
            limits = [view for view, split in self.of_protocol if split == "train"]
        grazings = [view.grazing_deg for view in limits]
        return random_views(count, min(grazings), max(grazings), seed)


@option_group
class TestViews:
    __test__ = False  # no class of tests

    test_protocol: bool = False
    """Test on the protocol's test views, with other training views."""
    test_azimuth: Angles = ()
    """Azimuths of the test views (default: those of the training views); training views are excluded."""
    test_grazing: Angles = ()
    """Grazing angles of the test views (default: those of the training views)."""
    test_incidence: Angles = ()
    """Incidence angles of the test views, instead of grazing angles."""

    @property
    def angles(self) -> dict[str, Angles]:
        """Typed test angles by option."""
        return {
            "test-azimuth": self.test_azimuth,
            "test-grazing": self.test_grazing,
            "test-incidence": self.test_incidence,
        }

    def splits(self, protocol: list[Split], train: Raster) -> list[Split]:
        """Return test views; angles that were not given are those of the training views."""
        if self.test_protocol:
            exclude("test-protocol", "sets the test views", self.angles)
            return [(view, split) for view, split in protocol if split != "train"]
        azimuth, grazing, incidence = self.angles.values()
        if not (azimuth or grazing or incidence):
            return []
        if not grazing and not incidence:
            _, grazing, incidence = train
        return [(view, "test") for view in views_from(azimuth or train[0], grazing, incidence, prefix="test-")]


def _direction(view: View) -> tuple[float, ...]:
    """Return the rounded unit vector towards the radar, equal for −30° and 330°."""
    return tuple(view.direction.round(9).tolist())


@option_group
class Isar:
    isar: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z …", help_behavior_hint="(optional)")] = ()
    """Inverse SAR of a target in free space instead: axes about which it turns, in its own frame, three numbers each.
    Of each axis, frames are spread over a whole turn, and test frames lie between them (docs/how-to/isar.md)."""
    line_of_sight: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z")] = (1.0, 0.0, 0.5)
    """From the target to the radar in the first frame of every axis, in the target's frame."""
    frames: int = 24
    """Training frames of all axes together."""

    def splits(self) -> list[Split]:
        """Return training frames, evenly around each axis in turn, and test frames halfway between them."""
        import numpy as np
        from scipy.spatial.transform import Rotation

        from sarsplat.geometry import View

        axes, sight = self.isar, self.line_of_sight
        require_count("isar", axes, range(3, len(axes) + 1, 3), "three for each axis of rotation, such as 0 0 1")
        require_count("line-of-sight", sight, (3,), "three, such as 1 0 0.5")
        if not 1 <= self.frames <= _MOST_FRAMES:
            raise SarsplatError(f"--frames {self.frames} must be 1 to {_MOST_FRAMES}")
        vectors = np.array(axes, float).reshape(-1, 3)
        views = []
        for number, axis in enumerate(vectors):
            count = (self.frames + number) // len(vectors)
            View.isar(sight, axis)  # raises if parallel or zero
            unit = axis / np.linalg.norm(axis)
            for k in range(2 * count):
                turned = Rotation.from_rotvec(-np.pi * k / count * unit).apply(sight)  # the target turns the other way
                views.append((View.isar(turned, axis), "test" if k % 2 else "train"))
        return views


@option_group
class Sensor:
    pixels: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N]", help_behavior_hint="(optional)")] = ()
    """Size of an image: one number, or rows (slant range) and columns (azimuth) (default: the protocol's 128)."""
    spacing: Lengths = ()
    """Pixel spacing: one number, or azimuth and slant range (default: the protocol's)."""
    resolution: Lengths = ()
    """3 dB width: one number, or azimuth and slant range (default: the spacing, or the protocol's)."""
    response: str = "gaussian"
    """Shape of the system's response: gaussian, or taylor, with side lobes at −35 dB (ray casting only)."""
    looks: OptionalNumber = None
    """Looks of multiplicative speckle; 1 is single look (default: no speckle)."""
    clean_tests: bool = False
    """Speckle the training images only, so that the test images are scored as noise-free ones."""

    def grid(self, protocol: str, village: bool = False) -> ImageGrid:
        """Return the protocol's pixels, changed as these options say."""
        from sarsplat.geometry.responses import response_of
        from sarsplat.scenes import mstar_grid, paper_grid

        grid = paper_grid() if protocol == "paper" else mstar_grid()
        pixels = self.pixels or (_VILLAGE_PIXELS,) * village
        require_count("pixels", pixels, (0, 1, 2), "one, or two: rows and columns")
        if pixels:
            grid = replace(grid, rows=pixels[0], columns=pixels[-1])
        if (spacing_m := pair(self.spacing, "spacing")) is not None:
            grid = replace(grid, spacing_m=spacing_m, resolution_m=spacing_m)
        resolution_m = pair(self.resolution, "resolution") or grid.resolution_m
        return replace(grid, resolution_m=resolution_m, response=response_of({"kind": self.response}))


@option_group
class Ground:
    ground: OptionalNumber = None
    """γ⁰ (linear) of the ground (default: no ground)."""
    terrain: OptionalFile = None
    """Heights of the ground (GeoTIFF, metres), its middle, where z = 0, at the target's origin (default: flat). The
    target is not moved."""
    ground_reflectivity: OptionalNumber = None
    """Share of the power that the ground reflects like a mirror in second bounces, 0 to 1; needs --ground."""

    def relief(self, bounces: int) -> Terrain | None:
        """Return the terrain, None if flat; raise if it or the bounces do not fit the ground."""
        from sarsplat.scenes.scattering import check_ground

        relief = heights(self.terrain)
        check_ground(self.ground, relief, bounces, self.ground_reflectivity)
        return relief


@option_group
class Echoes:
    source: Simulator = "raycast"
    """Ray casting, which is independent of the renderer, or the renderer itself, on Gaussians that cover the
    surface."""
    bounces: Literal[1, 2] = 1
    """2: also second bounces, by way of flat ground (facet–ground, ground–facet) and, by ray casting, from facet to
    facet."""
    ray_spacing: Metres = None
    """Distance of the rays along edges in ray casting (default: a fifteenth of the resolution). The error that it
    causes in the first image is printed."""
    masks: bool = False
    """Also write true masks of all images, by ray casting, to DIR/masks: 0 clutter, 1 target, 2 shadow on flat
    ground (for `evaluate --masks` and `reconstruct --method dsr --masks`)."""


@option_group
class Stacks:
    passes: OptionalCount = None
    """Simulate complex stacks of this number of passes a little apart in elevation, of one look
    (docs/concepts/stacks.md)."""
    baseline: Annotated[tuple[float, ...], tyro.conf.arg(metavar="RAD …", help_behavior_hint="(optional)")] = ()
    """b/R from the first pass to the last, rad, the others evenly between; or that of each pass."""
    wavelength: Metres = None
    """Wavelength of stacks, m (default: 0.031)."""
    noise: OptionalNumber = None
    """Power of the noise of each channel of a stack, β⁰ (default: none)."""
    polarimetric: bool = False
    """Simulate stacks of HH, HV and VV, of every pass or without passes: facets return by one bounce where they are
    level, by two where they are upright, and as volumes do where they slope."""

    def stack(self) -> Stack | None:
        """Return the stack, the polarisations of each pass one after the other; None for single images."""
        from sarsplat.geometry import Stack
        from sarsplat.scenes.mechanisms import POLARISATIONS

        if self.passes is None and not self.polarimetric:
            given = {"baseline": self.baseline or None, "wavelength": self.wavelength, "noise": self.noise}
            require("--passes or --polarimetric", {name: value is not None for name, value in given.items()})
            return None
        names = POLARISATIONS if self.polarimetric else ("",)
        offsets = [offset for offset in self._offsets() for _ in names]
        return Stack(
            X_BAND_M if self.wavelength is None else self.wavelength,
            tuple(offsets),
            noise=None if self.noise is None else (self.noise,) * len(offsets),
            polarisations=names * (len(offsets) // len(names)) if self.polarimetric else None,
        )

    def _offsets(self) -> list[float]:
        """Return b/R of each pass; a single baseline is divided evenly around the view."""
        passes, baseline = self.passes, self.baseline
        if passes is None:
            require("--passes", {"baseline": baseline})
            return [0.0]
        if passes < 2:
            raise SarsplatError(f"--passes is {passes}; give at least 2, or leave it out")
        require_count("baseline", baseline, (1, passes), "one, from the first to the last pass, or one of each, rad")
        if len(baseline) == passes:
            return [*baseline]
        return [baseline[0] * (k / (passes - 1) - 0.5) for k in range(passes)]


@option_group
class Options:
    """Options of `sarsplat simulate`."""

    out: Folder
    """Dataset folder to write."""
    seed: int = 0
    """Random seed of speckle, reflectivity and views."""
    overwrite: bool = False
    """Replace an existing dataset."""
    target: Group[Target] = Target()
    views: Group[Views] = Views()
    test_views: Group[TestViews] = TestViews()
    isar: Group[Isar] = Isar()
    sensor: Group[Sensor] = Sensor()
    ground: Group[Ground] = Ground()
    echoes: Group[Echoes] = Echoes()
    stacks: Group[Stacks] = Stacks()

    def reject_with_isar(self) -> None:
        """Raise for options that inverse SAR does not support."""
        given = {"azimuth": any(self.views.raster), **self.test_views.angles}
        given |= {"test-protocol": self.test_views.test_protocol, "random-views": self.views.random_views is not None}
        given |= {"tilt": self.views.tilt != 0, "side": self.views.side != "right"}
        given |= {"ground": self.ground.ground is not None, "masks": self.echoes.masks}
        given |= {"passes": self.stacks.passes is not None, "polarimetric": self.stacks.polarimetric}
        exclude("isar", "sets all views and has no ground", given)

    def reject_with_stacks(self) -> None:
        """Raise for options that stacks do not support."""
        sensor, echoes = self.sensor, self.echoes
        given = {"looks": sensor.looks, "clean-tests": sensor.clean_tests, "terrain": self.ground.terrain}
        given |= {"reflectivity": self.target.reflectivity, "ray-spacing": echoes.ray_spacing, "masks": echoes.masks}
        given |= {"bounces 2": echoes.bounces == 2, f"source {echoes.source}": echoes.source != "raycast"}
        exclude("polarimetric" if self.stacks.passes is None else "passes", "makes stacks, not single images", given)
