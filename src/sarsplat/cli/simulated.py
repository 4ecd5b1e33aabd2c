"""What options of `sarsplat simulate` ask for: views (of a protocol, a raster, or by chance), and stacks of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sarsplat.cli.arguments import Angles, views_from
from sarsplat.errors import SarsplatError

if TYPE_CHECKING:
    import numpy as np
    import trimesh

    from sarsplat.geometry import ImageGrid, Stack, View
    from sarsplat.scenes import ScatteringLaw

X_BAND_M = 0.031
"""Wavelength where none is given."""

_MOST_FRAMES = 10_000

Raster = tuple[Angles, Angles, Angles]
"""What was given of a raster of views: azimuths, grazing angles, and incidence angles instead of these."""


def simulated_views(
    theirs: list[tuple[View, str]], train: Raster, random: int | None, seed: int, test: Raster, test_theirs: bool
) -> list[tuple[View, str]]:
    """Views with their splits: `theirs`, the protocol's, where nothing else is given.

    `random` training views lie between the lowest and the highest grazing angle; with `test_theirs` the test views are
    the protocol's, whatever the training views are.
    """
    if random is not None:
        own = _random(theirs, train, random, seed)
    elif any(train):
        own = views_from(*train)
    elif any(test):
        raise SarsplatError(
            "test views were given, but the protocol sets both training and test views; give --azimuth as well"
        )
    else:
        return theirs
    tested = _test(theirs, train, test, test_theirs)
    seen = {_towards(view) for view in own}
    unseen = [(view, split) for view, split in tested if _towards(view) not in seen]
    if tested and not unseen:
        raise SarsplatError(f"all {len(tested)} test views are also training views; choose others with --test-azimuth")
    return [*((view, "train") for view in own), *unseen]


def _towards(view: View) -> tuple[float, ...]:
    """The same for −30° and 330°."""
    return tuple(view.direction.round(9).tolist())


def _random(theirs: list[tuple[View, str]], given: Raster, count: int, seed: int) -> list[View]:
    from sarsplat.scenes.protocols import random_views

    azimuth, grazing, incidence = given
    if azimuth:
        raise SarsplatError("--random-views draws the azimuths, but --azimuth was given; leave out one of them")
    if grazing or incidence:
        limits = views_from(("0",), grazing, incidence)
    else:
        limits = [view for view, split in theirs if split == "train"]
    grazings = [view.grazing_deg for view in limits]
    return random_views(count, min(grazings), max(grazings), seed)


def _test(theirs: list[tuple[View, str]], train: Raster, given: Raster, test_theirs: bool) -> list[tuple[View, str]]:
    if test_theirs:
        if any(given):
            raise SarsplatError("both --test-protocol and test angles were given; give only one of them")
        return [(view, split) for view, split in theirs if split != "train"]
    if not any(given):
        return []
    azimuth, grazing, incidence = given
    if not grazing and not incidence:
        _, grazing, incidence = train
    return [(view, "test") for view in views_from(azimuth or train[0], grazing, incidence, prefix="test-")]


def isar_views(axes: tuple[float, ...], sight: tuple[float, ...], frames: int) -> list[tuple[View, str]]:
    """Training frames, evenly around each axis of rotation in turn, and test frames halfway between them.

    `axes` are three numbers each, `sight` the line of sight of the first frame of each, in the target's frame.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from sarsplat.geometry import View

    if not axes or len(axes) % 3:
        raise SarsplatError(f"--isar has {len(axes)} numbers; give three for each axis of rotation, such as 0 0 1")
    if len(sight) != 3:
        raise SarsplatError(f"--line-of-sight has {len(sight)} numbers; give three, such as 1 0 0.5")
    if not 1 <= frames <= _MOST_FRAMES:
        raise SarsplatError(f"--frames {frames} must be 1 to {_MOST_FRAMES}")
    every = np.array(axes, float).reshape(-1, 3)
    views = []
    for number, axis in enumerate(every):
        count = (frames + number) // len(every)
        View.isar(sight, axis)  # they must not be along one line, nor nothing
        unit = axis / np.linalg.norm(axis)
        for k in range(2 * count):
            turned = Rotation.from_rotvec(-np.pi * k / count * unit).apply(sight)  # the target turns the other way
            views.append((View.isar(turned, axis), "test" if k % 2 else "train"))
    return views


def asked_stack(
    passes: int | None,
    baseline: tuple[float, ...],
    wavelength: float | None,
    noise: float | None,
    polarimetric: bool,
) -> Stack | None:
    """The stack that options ask for; None if they ask for single images.

    `baseline` is b/R from the first pass to the last, between which the others are spread evenly around the view, or
    that of each pass. All polarisations of a pass come one after the other.
    """
    from sarsplat.geometry import Stack
    from sarsplat.scenes.mechanisms import POLARISATIONS

    if passes is None and not polarimetric:
        given = {"--baseline": baseline or None, "--wavelength": wavelength, "--noise": noise}
        if (name := next((name for name, value in given.items() if value is not None), None)) is not None:
            raise SarsplatError(f"{name} is for stacks; give --passes or --polarimetric too, or leave it out")
        return None
    names = POLARISATIONS if polarimetric else ("",)
    offsets = [offset for offset in _offsets(passes, baseline) for _ in names]
    return Stack(
        X_BAND_M if wavelength is None else wavelength,
        tuple(offsets),
        noise=None if noise is None else (noise,) * len(offsets),
        polarisations=names * (len(offsets) // len(names)) if polarimetric else None,
    )


def _offsets(passes: int | None, baseline: tuple[float, ...]) -> list[float]:
    """b/R of each pass."""
    if passes is None:
        if baseline:
            raise SarsplatError("--baseline is between passes; give --passes too, or leave it out")
        return [0.0]
    if passes < 2:
        raise SarsplatError(f"--passes is {passes}; give at least 2, or leave it out")
    if len(baseline) not in (1, passes):
        raise SarsplatError(
            f"--baseline has {len(baseline)} numbers for {passes} passes; give one, from the first to the last, or "
            "one for each (b/R, rad)"
        )
    if len(baseline) == 1 and baseline[0] == 0:
        raise SarsplatError("--baseline is 0, so that all passes would be the same; give b/R in radians, such as 0.004")
    return [*baseline] if len(baseline) == passes else [baseline[0] * (k / (passes - 1) - 0.5) for k in range(passes)]


def refuse_with_stacks(options: Mapping[str, object], source: str) -> None:
    """Refuse options that the simulation of stacks has none of."""
    if (name := next((name for name, value in options.items() if value), None)) is not None:
        raise SarsplatError(f"--{name} is for single images; leave it out, or --passes and --polarimetric")
    if source != "raycast":
        raise SarsplatError(f"--source {source} makes no stacks; leave it out, or --passes and --polarimetric")


def simulated_signals(
    mesh: trimesh.Trimesh,
    views: list[View],
    grid: ImageGrid,
    stack: Stack,
    law: ScatteringLaw,
    ground_gamma0: float | None,
    seed: int,
) -> np.ndarray:
    """Signals of every view [V, P, rows, columns], complex64; each view has scatterers of its own."""
    import numpy as np

    from sarsplat.progress import progress
    from sarsplat.scenes import Mechanisms, simulate_stack

    seeds = np.random.SeedSequence(seed).generate_state(len(views))
    noise = 0.0 if stack.noise is None else stack.noise[0]
    mechanisms = Mechanisms.by_slope(mesh) if stack.polarimetric else None
    signals = np.empty((len(views), len(stack), grid.rows, grid.columns), np.complex64)
    with progress("simulate stacks", len(views)) as shown:
        for index, (view, own) in enumerate(zip(views, seeds, strict=True)):
            signals[index] = simulate_stack(
                mesh,
                view,
                grid,
                stack,
                law,
                ground_gamma0=ground_gamma0,
                mechanisms=mechanisms,
                noise=noise,
                seed=int(own),
            )
            shown.advance(1)
    return signals
