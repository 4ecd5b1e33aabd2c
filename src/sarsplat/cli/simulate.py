"""`sarsplat simulate`: simulate a dataset of SAR images from a mesh."""

from __future__ import annotations

import shlex
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import (
    Angles,
    Folder,
    Lengths,
    Metres,
    OptionalCount,
    OptionalFile,
    OptionalNumber,
    TargetBox,
    corners,
    heights,
    one_of,
    pair,
    refuse_existing,
)
from sarsplat.cli.simulated import (
    asked_stack,
    isar_views,
    refuse_with_stacks,
    simulated_signals,
    simulated_views,
)
from sarsplat.errors import SarsplatError, counted
from sarsplat.names import RadarSide, Simulator, TargetName

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import trimesh

    from sarsplat.data import Dataset, DatasetEntry
    from sarsplat.geometry import ImageGrid, Stack, View

Decibels = Annotated[float, tyro.conf.arg(metavar="DB")]
Law = Annotated[tuple[float, float] | tuple[float, float, float], tyro.conf.arg(metavar="FLOOR LOBE [EXPONENT]")]

_VILLAGE_PIXELS = 256  # on a side: a handful of houses
_TOLERABLE_DB = 0.1  # of an image's error by its rays


def simulate(
    *,
    out: Folder,
    target: Annotated[TargetName | None, one_of(TargetName)] = None,
    mesh: OptionalFile = None,
    scale: float = 1.0,
    recentre: bool = False,
    protocol: Literal["paper", "mstar"] = "paper",
    azimuth: Angles = (),
    grazing: Angles = (),
    incidence: Angles = (),
    random_views: OptionalCount = None,
    test_protocol: bool = False,
    test_azimuth: Angles = (),
    test_grazing: Angles = (),
    test_incidence: Angles = (),
    tilt: float = 0.0,
    side: RadarSide = "right",
    isar: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z …", help_behavior_hint="(optional)")] = (),
    line_of_sight: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z")] = (1.0, 0.0, 0.5),
    frames: int = 24,
    source: Simulator = "raycast",
    law: Law = (0.1, 0.9),
    reflectivity: Decibels = 0.0,
    ground: OptionalNumber = None,
    terrain: OptionalFile = None,
    bounces: Literal[1, 2] = 1,
    ground_reflectivity: OptionalNumber = None,
    looks: OptionalNumber = None,
    clean_tests: bool = False,
    pixels: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N]", help_behavior_hint="(optional)")] = (),
    spacing: Lengths = (),
    resolution: Lengths = (),
    response: str = "gaussian",
    ray_spacing: Metres = None,
    target_box: TargetBox = None,
    masks: bool = False,
    passes: OptionalCount = None,
    baseline: Annotated[tuple[float, ...], tyro.conf.arg(metavar="RAD …", help_behavior_hint="(optional)")] = (),
    wavelength: Metres = None,
    noise: OptionalNumber = None,
    polarimetric: bool = False,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Simulate SAR images of a target as a dataset.

    Parameters
    ----------
    out
        Dataset folder to write.
    target
        A built-in target: a vehicle, one of the paper's buildings, a satellite or an aircraft (with --isar), or a
        village, .64 as wide as the images (256 pixels unless others are given), of houses drawn by --seed.
    mesh
        A mesh file instead: metres, +x nose, +y left, +z up, ground at z = 0 but for --isar.
    scale
        Factor on the target's size, such as 0.001 for a mesh in millimetres.
    recentre
        Bring the middle of the target above the origin, where images are centred, and its lowest place to z = 0, such
        as one in map coordinates; with --isar its middle to the origin.
    protocol
        Views and pixels: 24 training + 48 test views at 15, 45, 75° incidence (paper), or 36 + 72 at 17 and 15° grazing
        (mstar).
    azimuth
        Training azimuths, instead of the protocol's: degrees or start:stop:step (stop excluded), e.g. 0:360:15.
    grazing
        Training grazing angles, degrees, between 0 and 90.
    incidence
        Incidence angles (90° − grazing), instead of grazing angles.
    random_views
        Number of random training views instead, between the lowest and the highest of the grazing angles (default: the
        protocol's).
    test_protocol
        Test on the protocol's test views, with training views of your own.
    test_azimuth
        Azimuths of the test views (default: those of the training views); training views are excluded.
    test_grazing
        Grazing angles of the test views (default: those of the training views).
    test_incidence
        Incidence angles of the test views, instead of grazing angles.
    tilt
        Angle by which the azimuth axis of all images rises above the level one, degrees: of a radar that squints,
        climbs or dives.
    side
        On which side of its flight the radar looks.
    isar
        Inverse SAR of a target in free space instead: axes about which it turns, in its own frame, three numbers each.
        Of each axis, frames are spread over a whole turn, and test frames lie between them (docs/how-to/isar.md).
    line_of_sight
        From the target to the radar in the first frame of every axis, in the target's frame.
    frames
        Training frames of all axes together.
    source
        Ray casting, which is independent of the renderer, or the renderer itself, on Gaussians that cover the surface.
    law
        γ⁰ (linear) of the target's surface: FLOOR + LOBE·|cos i|^EXPONENT (default: 2), with i the angle between its
        normal and the radar. Constant: 1 0. Lambert: 0 1 1.
    reflectivity
        Draw a factor on γ⁰ for every connected part of the mesh, log-normally, with this standard deviation.
    ground
        γ⁰ (linear) of the ground (default: no ground).
    terrain
        Heights of the ground (GeoTIFF, metres), its middle, where z = 0, at the target's origin (default: flat). The
        target is not moved.
    bounces
        2: also second bounces, by way of flat ground (facet–ground, ground–facet) and, by ray casting, from facet to
        facet.
    ground_reflectivity
        Of second bounces, with --ground: the share of the power that the ground reflects like a mirror, 0 to 1.
    looks
        Looks of multiplicative speckle; 1 is single look (default: no speckle).
    clean_tests
        Speckle the training images only, so that the test images are scored as noise-free ones.
    pixels
        Size of an image: one number, or rows (slant range) and columns (azimuth) (default: the protocol's 128).
    spacing
        Pixel spacing: one number, or azimuth and slant range (default: the protocol's).
    resolution
        3 dB width: one number, or azimuth and slant range (default: the spacing, or the protocol's).
    response
        Shape of the system's response: gaussian, or taylor, with side lobes at −35 dB (ray casting only).
    ray_spacing
        Distance of the rays along edges in ray casting (default: a fifteenth of the resolution). What it changes in the
        first image is told.
    target_box
        Lower and upper corner of the box in which reconstructions look for the target, m. Without it, they derive it
        from the images.
    masks
        Also write true masks of all images, by ray casting, to DIR/masks: 0 clutter, 1 target, 2 shadow on flat ground
        (for `evaluate --masks` and `reconstruct --method dsr --masks`).
    passes
        Simulate stacks of so many passes a little apart in elevation, complex, of one look (docs/concepts/stacks.md).
    baseline
        b/R from the first pass to the last, rad, the others evenly between; or that of each pass.
    wavelength
        Of stacks, m (default: 0.031).
    noise
        Of stacks, power of each channel's noise, β⁰ (default: none).
    polarimetric
        Simulate stacks of HH, HV and VV, of every pass or without passes: facets return by one bounce where they are
        level, by two where they are upright, and as volumes do where they slope.
    seed
        Random seed of speckle, reflectivity and views.
    overwrite
        Replace an existing dataset.
    """
    from sarsplat.data import Dataset
    from sarsplat.data.dataset_folder import HEADER
    from sarsplat.data.masks import pillow
    from sarsplat.examination.plausible import warn
    from sarsplat.geometry.responses import response_of
    from sarsplat.progress import progress
    from sarsplat.scenes import ScatteringLaw, load_mesh, mstar_views, paper_views, target_mesh
    from sarsplat.scenes.meshes import is_larger, scaled, side_m, suspicious_size
    from sarsplat.scenes.placement import lost_digits, outside_images, recentred, warn_below_ground
    from sarsplat.scenes.raycast import default_ray_spacing, ray_error_db, raycast_masks
    from sarsplat.scenes.scattering import check_ground, part_reflectivity
    from sarsplat.scenes.simulate import simulate_images, simulation_record
    from sarsplat.scenes.targets import ALOFT
    from sarsplat.scenes.village import FITTING, village

    if clean_tests and looks is None:
        raise SarsplatError("--clean-tests keeps speckle out of the test images, but there is none; give --looks too")
    relief = heights(terrain)
    check_ground(ground, relief, bounces, ground_reflectivity)
    if masks and relief is not None:
        raise SarsplatError("--masks are of a target on flat ground; leave out --masks or --terrain")
    if masks:
        pillow()  # if it is missing, that is said before minutes of ray casting
    theirs = paper_views() if protocol == "paper" else mstar_views()
    own, test = (azimuth, grazing, incidence), (test_azimuth, test_grazing, test_incidence)
    views = simulated_views(theirs, own, random_views, seed, test, test_protocol)
    views = [(replace(view, tilt_deg=tilt, side=side), split) for view, split in views]
    if isar:
        others = {"azimuth": any(own), "test-azimuth": any(test), "test-protocol": test_protocol}
        others |= {"random-views": random_views is not None, "tilt": tilt != 0, "side": side != "right"}
        others |= {"ground": ground is not None, "masks": masks}
        others |= {"passes": passes is not None, "polarimetric": polarimetric}
        if given := [name for name, there in others.items() if there]:
            raise SarsplatError(f"--isar has views of its own and no ground, but --{given[0]} was given; leave out one")
        views = isar_views(isar, line_of_sight, frames)
    elif target in ALOFT:
        raise SarsplatError(f"the {target} is in free space; give the axis about which it turns, such as --isar 0 0 1")
    if target == "village" and not pixels:
        pixels = (_VILLAGE_PIXELS,)
    grid = replace(_grid(protocol, pixels, spacing, resolution), response=response_of({"kind": response}))
    box_m = corners(target_box)
    if (stack := asked_stack(passes, baseline, wavelength, noise, polarimetric)) is not None:
        no_stacks = {"looks": looks, "clean-tests": clean_tests, "terrain": terrain, "reflectivity": reflectivity}
        no_stacks |= {"ray-spacing": ray_spacing, "masks": masks, "bounces 2": bounces == 2}
        refuse_with_stacks(no_stacks, source)
    refuse_existing(out, overwrite, marker=HEADER)
    if mesh is not None and target is None:
        surface, name = load_mesh(mesh), mesh.name
    elif target == "village" and mesh is None:
        surface, name = village(FITTING * side_m(grid), seed), target
    elif target is not None and mesh is None:
        surface, name = target_mesh(target), target
    else:
        problem = "both --target and --mesh were" if target else "neither --target nor --mesh was"
        raise SarsplatError(f"{problem} given; give exactly one of them, e.g. --target t72")
    surface = scaled(surface, scale)
    looked, gamma0 = [view for view, _ in views], ScatteringLaw(*law)
    exact = mesh is None or mesh.suffix.lower() in (".obj", ".off")  # in text are as many digits as were written
    odd, moved = [] if exact else lost_digits(surface, grid), None
    if recentre:
        surface, moved = recentred(surface, aloft=bool(isar))
        console.say("subtracted from the target's coordinates: " + ", ".join(f"{value:.10g}" for value in moved) + " m")
    warn([*odd, *outside_images(surface, looked, grid)])
    warn_below_ground(surface, grid, ground, relief)
    odd = suspicious_size(surface, grid)
    if odd and is_larger(surface, grid) and not pixels and not spacing:
        raise SarsplatError(odd[0])  # not minutes of work for images of a part that nobody chose
    warn(odd)
    about: dict[str, Any] = {"target": name, "ground": ground is not None, "target_box_m": box_m}
    if stack is not None:
        signals = simulated_signals(surface, looked, grid, stack, gamma0, ground, seed)
        record: dict[str, Any] = {"kind": "scatterers", "law": gamma0.as_dict(), "ground_gamma0": ground, "seed": seed}
        record |= {"mechanisms": "by slope", "scale": scale} if polarimetric else {"scale": scale}
        record |= _moved(moved)
        dataset = Dataset.of_complex(grid, _entries(views, stack), signals, looks=1.0, source=record, **about)
        _finish(out, dataset, surface, None, overwrite)
        return
    if ray_spacing is None and source == "raycast":
        ray_spacing = default_ray_spacing(surface, grid)
    elif ray_spacing is not None and ray_spacing > min(grid.spacing_m) / 2:
        spacing_m = min(grid.spacing_m)
        warn(
            [f"rays {ray_spacing:g} m apart miss what pixels of {spacing_m:g} m show; give at most {spacing_m / 2:g} m"]
        )
    scene: dict[str, Any] = {"law": gamma0, "ground_gamma0": ground, "ray_spacing": ray_spacing}
    scene |= {"bounces": bounces, "ground_reflectivity": ground_reflectivity}
    how = {"source": source, "seed": seed, **scene}
    scene |= {"reflectivity": part_reflectivity(surface, reflectivity, seed), "terrain": relief}
    error_db = None
    power_by_echo: dict[str, float] = {}
    with progress(f"simulate {name}", len(views)) as shown:
        if source == "raycast":
            error_db = ray_error_db(surface, looked[0], grid, **scene)
            if error_db is None:
                right = "is empty: they miss the target, or it lies outside"
            else:
                right = f"is right to {error_db:.2g} dB RMS"
                right += "; give a smaller --ray-spacing" * (error_db > _TOLERABLE_DB)
            shown.note(f"rays {ray_spacing:.3g} m apart along edges: the first image {right}")
        images = simulate_images(
            surface,
            looked,
            grid,
            source=source,
            seed=seed,
            **scene,
            looks=looks,
            clean=[index for index, (_, split) in enumerate(views) if clean_tests and split != "train"],
            progress=shown.update,
            power_by_echo=power_by_echo,
        )
        if power_by_echo:
            shown.note("power: " + ", ".join(f"{kind} {share:.0%}" for kind, share in power_by_echo.items()))
    true_masks = None
    if masks:
        with progress(f"masks of {name}", len(views)) as shown:
            true_masks = raycast_masks(surface, looked, grid, progress=shown.update)
    record = simulation_record(**how, power_by_echo=power_by_echo, ray_error_db=error_db)
    dataset = Dataset(
        grid,
        _entries(views),
        images,
        looks=looks,
        clean_tests=clean_tests,
        terrain=relief,
        place=None if relief is None else relief.place,
        **about,
        protocol=protocol if views == theirs and grid == _grid(protocol) else None,
        source={**record, "reflectivity_db": reflectivity, "scale": scale, **_moved(moved)},
    )
    _finish(out, dataset, surface, true_masks, overwrite)


def _moved(moved_m: tuple[float, float, float] | None) -> dict[str, list[float]]:
    return {} if moved_m is None else {"subtracted_m": [*moved_m]}


def _entries(views: list[tuple[View, str]], stack: Stack | None = None) -> tuple[DatasetEntry, ...]:
    from sarsplat.data import DatasetEntry

    digits = max(3, len(str(len(views) - 1)))
    return tuple(
        DatasetEntry(view, split, f"{index:0{digits}d}", stack=stack) for index, (view, split) in enumerate(views)
    )


def _finish(out: Path, dataset: Dataset, surface: trimesh.Trimesh, masks: np.ndarray | None, overwrite: bool) -> None:
    """Write the dataset, and print warnings, a summary and the next command."""
    from sarsplat.data import write_dataset
    from sarsplat.examination.plausible import suspicions, warn
    from sarsplat.regions.target_region import box_misses

    dataset, grid = write_dataset(out, dataset, truth_mesh=surface, masks=masks, overwrite=overwrite), dataset.grid
    warn([*suspicions(dataset), *box_misses(dataset)])
    counts = ", ".join(f"{len(dataset.select(split))} {split}" for split in dataset.splits())
    kind = f"{dataset.passes}-channel stack" if dataset.passes else "image"
    run = shlex.quote(f"{out}-run")
    console.finish(
        f"{out}: {counted(len(dataset), kind)} of {dataset.target} ({counts}), {grid.rows} × {grid.columns} pixels"
        + (f", and their masks in {out / 'masks'}" if masks is not None else ""),
        f"sarsplat reconstruct {shlex.quote(str(out))} --out {run}",
    )


def _grid(
    protocol: str, pixels: tuple[int, ...] = (), spacing: tuple[float, ...] = (), resolution: tuple[float, ...] = ()
) -> ImageGrid:
    from sarsplat.scenes import mstar_grid, paper_grid

    grid = paper_grid() if protocol == "paper" else mstar_grid()
    if len(pixels) > 2:
        raise SarsplatError(f"--pixels has {len(pixels)} numbers; give one, or two: rows and columns")
    if pixels:
        grid = replace(grid, rows=pixels[0], columns=pixels[-1])
    if (spacing_m := pair(spacing, "spacing")) is not None:
        grid = replace(grid, spacing_m=spacing_m, resolution_m=spacing_m)
    resolution_m = pair(resolution, "resolution")
    return grid if resolution_m is None else replace(grid, resolution_m=resolution_m)
