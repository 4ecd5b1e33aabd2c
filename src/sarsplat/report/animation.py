"""Animations that play in browsers: images with their view and scale below, as GIF, WebP or MP4."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Real, UInt8

from sarsplat.data import write_bytes
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import Recognises
from sarsplat.errors import SarsplatError
from sarsplat.extras import install_command
from sarsplat.geometry import ImageGrid, View
from sarsplat.report.figure import nice
from sarsplat.report.look import Look

if TYPE_CHECKING:
    from PIL import Image, ImageFont

Frame = UInt8[np.ndarray, "height width"]
Palette = UInt8[np.ndarray, "256 3"]

# Pixels.
_SIDE, _LARGEST = 480, 1920  # limits of the picture's longer side
_NARROWEST = 440  # minimum width: room for the text below
_FOOT, _LINE, _TEXT, _MARGIN = 30, 20, 14, 10
_BAR = (64, 6)  # width and height of the decibel scale

_INK = 190  # shade of text and lines, darker than bright echoes
_GIF_STEP = 4  # shades merged into one, invisibly, which halves the file
_SHORTEST_MS = 20  # minimum duration of a frame: browsers slow shorter ones down


def frame(
    power: Real[np.ndarray, "rows columns"], view: View, grid: ImageGrid, look: Look, *, unusual: bool = False
) -> Frame:
    """Draw β⁰ (linear power) as indices into the palette of its look, near range on top, with view and scales below.

    Sides are even; a metre is as long in azimuth as in slant range. `unusual` adds a line with `View.unusual`; all
    frames of an animation need the same.
    """
    from PIL import Image, ImageDraw

    extent = (grid.columns * grid.spacing_m[0], grid.rows * grid.spacing_m[1])
    per_metre = min(max(1 / min(grid.spacing_m), _SIDE / max(extent)), _LARGEST / max(extent))
    width, height = (max(2, 2 * round(length * per_metre / 2)) for length in extent)
    shade = Image.fromarray(look.shade(power).astype(np.float32))
    picture = np.asarray(shade.resize((width, height), Image.Resampling.BICUBIC))
    drawn = Image.new("L", (max(width, _NARROWEST), height + _FOOT + _LINE * unusual))
    drawn.paste(Image.fromarray(np.uint8(np.round(255 * np.clip(picture, 0, 1)))), ((drawn.width - width) // 2, 0))
    draw, middle = ImageDraw.Draw(drawn), height + _FOOT // 2

    def write(x: float, text: str, anchor: str, below: int = 0) -> None:
        draw.text((x, middle + below), text, fill=_INK, font=_font(), anchor=anchor)

    write(_MARGIN, f"azimuth {view.azimuth_deg % 360:.0f}°", "lm")
    write(_MARGIN + 100, f"grazing {view.grazing_deg:.0f}°", "lm")
    if unusual:
        write(_MARGIN, view.unusual.removeprefix(", "), "lm", below=_LINE)
    length_m = nice(extent[0] / 5)
    right = drawn.width - _MARGIN
    left = right - round(length_m * width / extent[0])
    draw.line([(left, middle), (right, middle)], fill=_INK)
    for x in (left, right):
        draw.line([(x, middle - 3), (x, middle + 3)], fill=_INK)
    write(left - 6, f"{length_m:g} m", "rm")
    left = (drawn.width - _BAR[0]) // 2 + 24
    for x in range(_BAR[0]):
        ends = [(left + x, middle + side * _BAR[1] // 2) for side in (-1, 1)]
        draw.line(ends, fill=round(255 * x / (_BAR[0] - 1)))
    write(left - 4, f"-{look.range_db:g}", "rm")
    write(left + _BAR[0] + 4, "0 dB", "lm")
    return np.asarray(drawn)


@cache
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(_TEXT)


def _gif(frames: Sequence[Frame], palette: Palette, durations_ms: list[int]) -> bytes:
    from PIL import Image

    pictures = [Image.fromarray(frame // _GIF_STEP * _GIF_STEP) for frame in frames]
    for picture in pictures:
        picture.putpalette(palette.tobytes())
    return _by_pillow("GIF", pictures, durations_ms)


def _webp(frames: Sequence[Frame], palette: Palette, durations_ms: list[int]) -> bytes:
    from PIL import Image

    return _by_pillow("WEBP", [Image.fromarray(palette[frame]) for frame in frames], durations_ms)


def _by_pillow(kind: str, pictures: list[Image.Image], durations_ms: list[int]) -> bytes:
    buffer = io.BytesIO()
    first, *others = pictures
    first.save(buffer, kind, save_all=True, append_images=others, duration=durations_ms, loop=0, optimize=False)
    return buffer.getvalue()


def _mp4(frames: Sequence[Frame], palette: Palette, durations_ms: list[int]) -> bytes:
    """VP9 in MP4: browsers play it, and its encoder is free of the GPL, unlike those of H.264 in Python packages."""
    try:
        import cv2
    except ImportError as error:
        raise SarsplatError(
            f".mp4 files need OpenCV, which is not installed; {install_command('video')}, or write a .gif or .webp file"
        ) from error
    height, width = frames[0].shape
    with tempfile.TemporaryDirectory() as folder, plain_os_errors("write", Path(folder)):
        path = Path(folder) / "animation.mp4"
        rate = 1000 * len(frames) / sum(durations_ms)
        video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"vp09"), rate, (width, height))
        if not video.isOpened():
            raise SarsplatError("this OpenCV cannot write .mp4 files; write a .gif or .webp file")
        for frame in frames:
            video.write(np.ascontiguousarray(palette[frame][:, :, ::-1]))  # BGR
        video.release()
        return path.read_bytes()


_WRITERS: dict[str, Callable[[Sequence[Frame], Palette, list[int]], bytes]] = {
    ".mp4": _mp4,
    ".gif": _gif,
    ".webp": _webp,
}

ANIMATIONS: dict[str, Recognises] = {
    ".mp4": lambda head, _: head[4:8] == b"ftyp",
    ".gif": lambda head, _: head.startswith(b"GIF8"),
    ".webp": lambda head, _: head.startswith(b"RIFF") and head[8:12] == b"WEBP",
}
"""Suffixes of animations, and tests that recognise such files."""


def write_animation(path: Path, frames: Sequence[Frame], palette: Palette, seconds: float) -> None:
    """Write frames as a looping animation that takes `seconds`; no partial file is left.

    The player decides if .mp4 loops. Frames have even sides and index into the palette (RGB). Raises
    `SarsplatError` if the frame rate is too high, a package is missing, or the file cannot be written.
    """
    if not 0 < seconds < 3600:
        raise SarsplatError(f"an animation cannot take {seconds:g} s; give more than 0 and less than 3600")
    ends_ms = 10 * np.round(100 * seconds * np.arange(len(frames) + 1) / len(frames)).astype(int)  # GIF counts 10 ms
    durations_ms = np.diff(ends_ms).tolist()
    if min(durations_ms) < _SHORTEST_MS:
        raise SarsplatError(
            f"{len(frames)} frames in {seconds:g} s are more than {1000 // _SHORTEST_MS} a second; give more seconds "
            "or fewer frames"
        )
    write_bytes(path, _WRITERS[path.suffix.lower()](frames, palette, durations_ms))
