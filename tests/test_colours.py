"""One definition of every colour that has a meaning."""

import re
from pathlib import Path

import numpy as np
import pytest

import sarsplat
from sarsplat import SarsplatError, colours

PACKAGE = Path(sarsplat.__file__).parent
RAMPS = (*colours.POWER_RAMPS, colours.HEIGHT, colours.ERROR, colours.DIFFERENCE)


@pytest.mark.parametrize("name", RAMPS)
def test_every_ramp_is_a_palette_a_gradient_and_a_colour_map(name: str) -> None:
    pytest.importorskip("matplotlib")
    palette = colours.ramp(name)
    assert palette.shape == (256, 4) and palette.dtype == np.uint8
    assert (np.abs(np.diff(palette.astype(int), axis=0)).max(axis=0)[3] <= 4).all()
    red, green, blue, _ = palette[0]
    assert f"rgb({red} {green} {blue} / " in colours.gradient(name)
    np.testing.assert_allclose(colours.colormap(name)(np.arange(256)), palette / 255)
    hollow = colours.hollow(name)
    assert hollow[0, 3] == 0 and (hollow[1:] == palette[1:]).all()


@pytest.mark.parametrize("name", colours.POWER_RAMPS[1:])
def test_ramps_of_matplotlib_that_are_kept_here_are_its_own(name: str) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    np.testing.assert_array_equal(colours.ramp(name), np.round(255 * matplotlib.colormaps[name](np.arange(256))))


def test_power_is_grey_without_matplotlib() -> None:
    assert (colours.ramp(colours.POWER)[:, :3] == np.arange(256)[:, None]).all()


def test_no_difference_looks_like_its_background_and_each_sign_has_a_colour() -> None:
    shown = colours.over(colours.DIFFERENCE, "#102030")
    assert np.abs(shown[127].astype(int) - (0x10, 0x20, 0x30)).max() <= 1
    assert tuple(shown[0]) == colours.rgb(colours.TOO_DARK)
    assert tuple(shown[255]) == colours.rgb(colours.TOO_BRIGHT)


@pytest.mark.parametrize("name", [colours.HEIGHT, colours.ERROR])
@pytest.mark.parametrize("background", [colours.LIGHT.ground, colours.DARK.ground])
def test_ramps_stand_out_from_both_pages(name: str, background: str) -> None:
    def luminance(rgb: np.ndarray) -> np.ndarray:
        share = np.asarray(rgb) / 255
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        return linear @ (0.2126, 0.7152, 0.0722)

    pair = np.stack([luminance(colours.ramp(name)[:, :3]), np.full(256, luminance(np.array(colours.rgb(background))))])
    assert ((pair.max(axis=0) + 0.05) / (pair.min(axis=0) + 0.05)).min() > 2


def test_an_unknown_ramp_is_refused() -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(SarsplatError, match="there is no colour map 'rainbows'; choose gray, viridis"):
        colours.ramp("rainbows")


def test_colours_are_defined_nowhere_else() -> None:
    hexadecimal = re.compile(r"#(?:[0-9a-fA-F]{3}){1,2}\b")
    named = re.compile(r"""["'](gray|viridis|inferno|magma|cividis|turbo|plasma)(_r)?["']""")
    files = [path for ending in ("py", "css", "js", "j2", "html") for path in PACKAGE.rglob(f"*.{ending}")]
    assert len(files) > 200
    for path in files:
        if path.name != "colours.py":
            text = path.read_text(encoding="utf-8")
            assert not hexadecimal.findall(text) and not named.findall(text), path
    for path in (path for folder in ("docs", "experiments") for path in (PACKAGE.parents[1] / folder).glob("*.py")):
        assert not re.findall(r"cmap=[\"']|get_cmap", path.read_text(encoding="utf-8")), path
