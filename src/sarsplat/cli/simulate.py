"""`sarsplat simulate`: simulate a dataset of SAR images from a mesh."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import corners, exclude, refuse_existing, require
from sarsplat.cli.simulation_options import Options, Sensor, Split
from sarsplat.errors import SarsplatError, counted
from sarsplat.extras import Trimesh

if TYPE_CHECKING:
    from sarsplat.data import Dataset, DatasetEntry
    from sarsplat.geometry import ImageGrid, Stack, Terrain, View
    from sarsplat.scenes import ScatteringLaw

_TOLERABLE_DB = 0.1  # maximum error of an image due to the ray spacing without advice, dB


@dataclass(frozen=True)
class _Scene:
    """Surface in the frame of the images, with views, pixels and ground."""

    name: str
    surface: Trimesh
    moved_m: tuple[float, float, float] | None
    """Vector that `--recentre` subtracted."""
    splits: list[Split]
    grid: ImageGrid
    relief: Terrain | None
    law: ScatteringLaw

    @property
    def views(self) -> list[View]:
        """Views without their splits."""
        return [view for view, _ in self.splits]


def simulate(options: Annotated[Options, tyro.conf.arg(name="")]) -> None:
    """Simulate SAR images of a target as a dataset."""
    from sarsplat.data import write_dataset
    from sarsplat.data.dataset_folder import HEADER
    from sarsplat.data.sidecar import pillow
    from sarsplat.examination.plausible import suspicions, warn
    from sarsplat.progress import progress
    from sarsplat.regions.target_region import box_misses
    from sarsplat.scenes.raycast import raycast_masks
    from sarsplat.scenes.targets import ALOFT

    out, target, ground, masks = options.out, options.target, options.ground, options.echoes.masks
    clean_tests = options.sensor.clean_tests
    require("--looks", {"clean-tests": clean_tests and options.sensor.looks is None})
    relief = ground.relief(options.echoes.bounces)
    if masks:
        exclude("masks", "shows a target on flat ground", {"terrain": relief is not None})
        pillow()  # raises before minutes of ray casting
    splits = options.views.splits(options.test_views, options.seed)
    if options.isar.isar:
        options.reject_with_isar()
        splits = options.isar.splits()
    elif (name := target.target) in ALOFT:
        raise SarsplatError(f"the {name} is in free space; give the axis about which it turns, such as --isar 0 0 1")
    no_tests = all(split == "train" for _, split in splits)
    require("test views, such as by --test-azimuth", {"clean-tests": clean_tests and no_tests})
    grid = options.sensor.grid(options.views.protocol, target.target == "village")
    box_m, stack = corners(target.target_box), options.stacks.stack()
    if stack is not None:
        options.reject_with_stacks()
    refuse_existing(out, options.overwrite, marker=HEADER)
    scene = _scene(options, splits, grid, relief)
    about: dict[str, Any] = {"target": scene.name, "ground": ground.ground is not None, "target_box_m": box_m}
    dataset = _images(options, scene, about) if stack is None else _stacks(options, scene, stack, about)
    true_masks = None
    if masks:
        with progress(f"masks of {scene.name}", len(scene.splits)) as shown:
            true_masks = raycast_masks(scene.surface, scene.views, scene.grid, progress=shown.update)
    dataset = write_dataset(out, dataset, truth_mesh=scene.surface, masks=true_masks, overwrite=options.overwrite)
    warn([*suspicions(dataset), *box_misses(dataset)])
    counts = ", ".join(f"{len(dataset.select(split))} {split}" for split in dataset.splits())
    kind = "image" if stack is None else f"{dataset.passes}-channel stack"
    console.finish(
        f"{out}: {counted(len(dataset), kind)} of {dataset.target} ({counts}), {grid.rows} × {grid.columns} pixels"
        + (f", and their masks in {out / 'masks'}" if masks else ""),
        shlex.join(["sarsplat", "reconstruct", str(out), "--out", f"{out}-run"]),
    )


def _scene(options: Options, splits: list[Split], grid: ImageGrid, relief: Terrain | None) -> _Scene:
    """Return the scene of --target or --mesh; warn of implausible places and sizes."""
    from sarsplat.examination.plausible import warn
    from sarsplat.scenes import ScatteringLaw, load_mesh, target_mesh
    from sarsplat.scenes.meshes import is_larger, scaled, side_m, suspicious_size
    from sarsplat.scenes.placement import lost_digits, outside_images, recentred, warn_below_ground
    from sarsplat.scenes.village import FITTING, village

    target, mesh, moved_m = options.target.target, options.target.mesh, None
    if mesh is not None and target is None:
        surface, name = load_mesh(mesh), mesh.name
    elif target is not None and mesh is None:
        surface = village(FITTING * side_m(grid), options.seed) if target == "village" else target_mesh(target)
        name = target
    else:
        problem = "both --target and --mesh were" if target else "neither --target nor --mesh was"
        raise SarsplatError(f"{problem} given; give exactly one of them, e.g. --target t72")
    surface = scaled(surface, options.target.scale)
    exact = mesh is None or mesh.suffix.lower() in (".obj", ".off")  # text holds all digits that were written
    found = [] if exact else lost_digits(surface, grid)
    if options.target.recentre:
        surface, moved_m = recentred(surface, aloft=bool(options.isar.isar))
        middle = ", ".join(f"{value:.10g}" for value in moved_m)
        console.say(f"subtracted from the target's coordinates: {middle} m")
    warn([*found, *outside_images(surface, [view for view, _ in splits], grid)])
    warn_below_ground(surface, grid, options.ground.ground, relief)
    found = suspicious_size(surface, grid)
    if found and is_larger(surface, grid) and not options.sensor.pixels and not options.sensor.spacing:
        raise SarsplatError(found[0])  # not minutes of work for images of a part that nobody chose
    warn(found)
    return _Scene(name, surface, moved_m, splits, grid, relief, ScatteringLaw(*options.target.law))


def _stacks(options: Options, scene: _Scene, stack: Stack, about: dict[str, Any]) -> Dataset:
    """Simulate stacks, with other scatterers in each view."""
    import numpy as np

    from sarsplat.data import Dataset
    from sarsplat.progress import progress
    from sarsplat.scenes import Mechanisms, simulate_stack

    views, grid, ground_gamma0 = scene.views, scene.grid, options.ground.ground
    seeds = np.random.SeedSequence(options.seed).generate_state(len(views))
    noise = 0.0 if stack.noise is None else stack.noise[0]
    mechanisms = Mechanisms.by_slope(scene.surface) if stack.polarimetric else None
    signals = np.empty((len(views), len(stack), grid.rows, grid.columns), np.complex64)
    with progress("simulate stacks", len(views)) as shown:
        for index, (view, seed) in enumerate(zip(views, seeds, strict=True)):
            signals[index] = simulate_stack(
                scene.surface,
                view,
                grid,
                stack,
                scene.law,
                ground_gamma0=ground_gamma0,
                mechanisms=mechanisms,
                noise=noise,
                seed=int(seed),
            )
            shown.advance(1)
    record = {"kind": "scatterers", "law": scene.law.as_dict(), "ground_gamma0": ground_gamma0, "seed": options.seed}
    record |= {"mechanisms": "by slope"} if stack.polarimetric else {}
    source = {**record, **_scaled_and_moved(options, scene)}
    return Dataset.of_complex(grid, _entries(scene, stack), signals, looks=1.0, source=source, **about)


def _images(options: Options, scene: _Scene, about: dict[str, Any]) -> Dataset:
    """Simulate single images."""
    import numpy as np

    from sarsplat.data import Dataset
    from sarsplat.progress import progress
    from sarsplat.scenes.raycast import ray_error_db
    from sarsplat.scenes.scattering import add_speckle, generator, part_reflectivity
    from sarsplat.scenes.simulate import simulate_images, simulation_record

    sensor, protocol, reflectivity_db = options.sensor, options.views.protocol, options.target.reflectivity
    about |= {"looks": sensor.looks, "clean_tests": sensor.clean_tests, "terrain": scene.relief}
    physics: dict[str, Any] = {"law": scene.law, "ground_gamma0": options.ground.ground}
    physics |= {"ray_spacing": _ray_spacing(options, scene), "bounces": options.echoes.bounces}
    physics |= {"ground_reflectivity": options.ground.ground_reflectivity}
    how = {"source": options.echoes.source, "seed": options.seed, **physics}
    physics["reflectivity"] = part_reflectivity(scene.surface, reflectivity_db, options.seed)
    physics["terrain"] = scene.relief
    error_db, speckle, power_by_echo = None, None, dict[str, float]()
    with progress(f"simulate {scene.name}", len(scene.splits)) as shown:
        if options.echoes.source == "raycast":
            error_db = ray_error_db(scene.surface, scene.views[0], scene.grid, **physics)
            verdict = "is empty: they miss the target, or it lies outside"
            if error_db is not None:
                advice = "; give a smaller --ray-spacing" * (error_db > _TOLERABLE_DB)
                verdict = f"is right to {error_db:.2g} dB RMS{advice}"
            shown.note(f"rays {physics['ray_spacing']:.3g} m apart along edges: the first image {verdict}")
        if sensor.looks is not None:  # first, so that an invalid number of looks raises before minutes of ray casting
            ones = np.ones((len(scene.splits), scene.grid.rows, scene.grid.columns), np.float32)
            speckle = add_speckle(ones, sensor.looks, generator(options.seed, "speckle"))
            speckle[[sensor.clean_tests and split != "train" for _, split in scene.splits]] = 1
        images = simulate_images(
            scene.surface,
            scene.views,
            scene.grid,
            source=options.echoes.source,
            **physics,
            progress=shown.update,
            power_by_echo=power_by_echo,
        )
        if speckle is not None:
            images *= speckle
        if power_by_echo:
            shown.note("power: " + ", ".join(f"{kind} {share:.0%}" for kind, share in power_by_echo.items()))
    record = simulation_record(**how, power_by_echo=power_by_echo, ray_error_db=error_db)
    usual = scene.splits == options.views.of_protocol and scene.grid == Sensor().grid(protocol)
    return Dataset(
        scene.grid,
        _entries(scene),
        images,
        place=None if scene.relief is None else scene.relief.place,
        **about,
        protocol=protocol if usual else None,
        source={**record, "reflectivity_db": reflectivity_db, **_scaled_and_moved(options, scene)},
    )


def _ray_spacing(options: Options, scene: _Scene) -> float | None:
    """Return the distance of rays, m, None without ray casting; warn if pixels are finer."""
    from sarsplat.examination.plausible import warn
    from sarsplat.scenes.raycast import default_ray_spacing

    given_m, limit_m = options.echoes.ray_spacing, min(scene.grid.spacing_m) / 2
    if given_m is None:
        return default_ray_spacing(scene.surface, scene.grid) if options.echoes.source == "raycast" else None
    if given_m > limit_m:
        warn([f"rays {given_m:g} m apart miss what pixels of {2 * limit_m:g} m show; give at most {limit_m:g} m"])
    return given_m


def _scaled_and_moved(options: Options, scene: _Scene) -> dict[str, Any]:
    moved = {} if scene.moved_m is None else {"subtracted_m": [*scene.moved_m]}
    return {"scale": options.target.scale, **moved}


def _entries(scene: _Scene, stack: Stack | None = None) -> tuple[DatasetEntry, ...]:
    from sarsplat.data import DatasetEntry

    digits = max(3, len(str(len(scene.splits) - 1)))
    return tuple(
        DatasetEntry(view, split, f"{index:0{digits}d}", stack=stack)
        for index, (view, split) in enumerate(scene.splits)
    )
