"""An image by tiles is the image: without seams, whatever the height and the angle, and wherever it was stopped."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tifffile
import torch

from made import hill, upright
from sarsplat import Gaussians, Ground, Harmonics, SarsplatError, render, write_gaussians_ply
from sarsplat.cli import main
from sarsplat.geometry import ImageGrid, RayGrid, View, radar_frame
from sarsplat.learning import model
from sarsplat.tiles import at_once, render_tiled, tiles_kept_in
from sarsplat.tiles import render as module

GRID = ImageGrid(90, 130, spacing_m=(0.3, 0.25), resolution_m=(0.4, 0.3), center_m=(900.0, -700.0))
RAYS = RayGrid((0.2, 0.2))
VIEW = View(33.0, 45.0)
LITTLE = 0.0008  # GiB: for a few dozen pixels
TEXTURED = Ground(torch.rand(9, 9, generator=torch.Generator().manual_seed(3)), 4.0, exponent=torch.tensor(0.5))


def town(view: View, count: int = 3000) -> Gaussians:
    """Where the image is, flat clutter and towers as high as a third of it is wide."""
    g = torch.Generator().manual_seed(1)
    place = torch.rand(count, 3, generator=g)
    tower = (place[:, :2] * 6).floor().sum(1) % 3 == 0
    means = (place - 0.5) * torch.tensor([44.0, 60.0, 0.2])
    means[:, 2] += place[:, 2] * tower * 12
    azimuth, _, slant_range = torch.from_numpy(radar_frame(view)).float()
    flat = torch.tensor([1.0, 1.0, 0.0]) / math.cos(math.radians(view.grazing_deg)) ** 2
    means += GRID.center_m[0] * azimuth + GRID.center_m[1] * slant_range * flat
    scales = 0.12 * torch.exp(0.5 * torch.randn(count, 3, generator=g))
    scattering = Harmonics(2 * torch.randn(count, 4, generator=g), p_min=0.02)
    return Gaussians(means, torch.randn(count, 4, generator=g), scales, 0.2 + 5 * place[:, 0], scattering)


@pytest.fixture
def after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], list[Any]]:
    """Watches the tiles that are rendered, and presses Ctrl-C in place of the one after so many."""
    usual = module.tile_image

    def watch(most: int) -> list[Any]:
        tiles: list[Any] = []

        def watched(*arguments):
            if len(tiles) == most:
                raise KeyboardInterrupt
            tiles.append(arguments[3])
            return usual(*arguments)

        monkeypatch.setattr(module, "tile_image", watched)
        return tiles

    return watch


@pytest.mark.parametrize("ground", [None, Ground(torch.tensor(0.1)), TEXTURED], ids=["no-ground", "flat", "textured"])
@pytest.mark.parametrize(("grazing", "memory_gib"), [(15.0, LITTLE), (45.0, LITTLE), (75.0, 1.2 * LITTLE)])
def test_there_are_no_seams(grazing, memory_gib, ground, after):
    view, tiles = View(33.0, grazing), after(1000)
    scene, shift = town(view), torch.tensor([0.07, -0.11])
    tiled = render_tiled(scene, view, GRID, rays=RAYS, shift=shift, ground=ground, memory_gib=memory_gib)
    count = len(tiles)
    one = render_tiled(scene, view, GRID, rays=RAYS, shift=shift, ground=ground)
    assert len(tiles) == count + 1
    assert count >= 4
    assert (tiled - one).abs().max() <= 1e-6 * one.max()
    # which counts pixels from the image's centre, and may cut off another last pixel of a footprint
    whole = render(scene, [view], GRID, rays=RAYS, shift=shift[None], ground=ground).images[0]
    assert (tiled - whole).abs().max() <= 4e-4 * whole.max()
    assert (tiled - whole).abs().mean() <= 5e-5 * whole.mean()


def test_what_stands_in_one_tile_shades_another(after):
    """A wall of 20 m across the line of sight at 15°: the first 75 m behind it are dark."""
    view, grid, tiles = View(0.0, 15.0), ImageGrid(256, 32, (0.5, 0.5), (0.5, 0.5)), after(1000)  # the radar is at +x
    wall = torch.cartesian_prod(torch.tensor([40.0]), torch.arange(-10.0, 10.25, 0.25), torch.arange(0.25, 20.0, 0.5))
    floor = torch.cartesian_prod(torch.arange(-60.0, 60.0, 0.5), torch.arange(-8.0, 8.0, 0.5), torch.zeros(1))
    scene = upright(torch.cat([wall, floor]), 0.4, 5.0, 0.0)
    behind = render_tiled(scene, view, grid, memory_gib=0.004)[0, :, 16]
    alone = render_tiled(scene[len(wall) :], view, grid, memory_gib=0.004)[0, :, 16]
    assert len(tiles) > 2
    near, far = ([round(128 - x * math.cos(math.radians(15)) / 0.5) for x in ends] for ends in ((38, -25), (-42, -56)))
    assert alone[near[0] : near[1]].min() > 0.1
    assert behind[near[0] : near[1]].max() < 1e-3
    torch.testing.assert_close(behind[far[0] : far[1]], alone[far[0] : far[1]], rtol=1e-4, atol=0.0)


def test_a_stopped_rendering_goes_on(tmp_path: Path, after):
    scene, folder = town(VIEW), tmp_path / "tiles"

    def rendered(ground: Ground = TEXTURED) -> torch.Tensor:
        with tiles_kept_in(folder):
            return render_tiled(scene, VIEW, GRID, rays=RAYS, ground=ground, memory_gib=LITTLE)

    every = after(1000)
    at_one_go = rendered()
    assert not folder.exists()
    after(3)
    with pytest.raises(KeyboardInterrupt):
        rendered()
    assert len([*folder.rglob("*.npy")]) == 3
    # the other ground's values differ where `repr` shows none of them
    others = after(0)
    texture = TEXTURED.gamma0.clone()
    texture[4, 4] += 1e-3
    with pytest.raises(KeyboardInterrupt):
        rendered(Ground(texture, 4.0, exponent=TEXTURED.exponent))
    assert others == []
    rest = after(1000)
    assert torch.equal(rendered(), at_one_go)
    assert len(rest) == len(every) - 3
    assert not folder.exists()


def test_a_folder_of_something_else_is_spared(tmp_path: Path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(SarsplatError, match=r"holds thesis\.tex, which is not a tile"), tiles_kept_in(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("memory_gib", "complaint"),
    [(0.0, "memory_gib 0.0 must be positive"), (1e-5, r"pixels alone need \d+ Gaussians .* allow more memory_gib")],
)
def test_what_cannot_be_is_refused(memory_gib: float, complaint: str):
    with pytest.raises(SarsplatError, match=complaint):
        render_tiled(town(VIEW), VIEW, GRID, rays=RAYS, memory_gib=memory_gib)


def test_tiles_begin_where_memory_ends():
    scene, views = town(VIEW), [VIEW] * 9
    assert at_once(scene, views, GRID, RAYS) == 9
    assert at_once(scene, views, GRID, RayGrid((0.01, 0.01))) < 9
    assert at_once(scene, views, GRID, RayGrid((0.002, 0.002))) == 0
    assert at_once(scene, views, ImageGrid(16384, 16384, (0.3, 0.3), (0.3, 0.3)), RAYS) == 0


def test_the_command_goes_on_too(tmp_path: Path, after, monkeypatch: pytest.MonkeyPatch, capsys):
    scene = town(VIEW, 200)
    write_gaussians_ply(tmp_path / "town.ply", scene.with_tensors(means=scene.means - scene.means.mean(0)))
    words = f"render {tmp_path}/town.ply --azimuth 30 --grazing 40 --pixels 1030 20 --spacing 0.2".split()
    assert main([*words, "--out", f"{tmp_path}/at-once.tif"]) == 0
    usual = model.at_once
    monkeypatch.setattr(
        model, "at_once", lambda scene, views, grid, rays: usual(*(scene, views, grid, rays)) * (grid.rows < 1000)
    )
    after(1)
    assert main([*words, "--out", f"{tmp_path}/tiles.tif"]) == 130
    assert f"{tmp_path}/.tiles.tif.tiles keeps what is finished" in " ".join(capsys.readouterr().err.split())
    rest = after(1000)
    assert main([*words, "--out", f"{tmp_path}/tiles.tif"]) == 0
    assert len(rest) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["at-once.tif", "tiles.tif", "town.ply"]
    whole, tiled = (tifffile.imread(tmp_path / f"{name}.tif") for name in ("at-once", "tiles"))
    assert whole.max() > 0
    assert abs(tiled - whole).max() <= 4e-4 * whole.max()


@pytest.mark.parametrize("view", [VIEW, View(250.0, 20.0)])
def test_terrain_has_no_seams_either(view, after, tmp_path):
    """Hills shade what other tiles show; and tiles of another terrain are not taken for those of this one."""
    grid, g = ImageGrid(70, 60, (0.3, 0.25), (0.4, 0.3)), torch.Generator().manual_seed(2)
    place = (torch.rand(400, 3, generator=g) - 0.5) * torch.tensor([14.0, 14.0, 1.0])
    scene = town(view, 400).with_tensors(means=place + torch.tensor([0.0, 0.0, 1.0]))
    low, high = (Ground(TEXTURED.gamma0, 2.0, hill(height), TEXTURED.exponent) for height in (1.0, 4.0))
    tiles = after(1000)
    with tiles_kept_in(tmp_path):
        for ground in (low, high):
            expected = render(scene, [view], grid, rays=RAYS, ground=ground).images[0]
            found = render_tiled(scene, view, grid, rays=RAYS, ground=ground, memory_gib=LITTLE / 3)
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.max()))
    assert len(tiles) > 2
