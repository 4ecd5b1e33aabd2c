"""Views of a sweep, and rendered images as a folder, a single image, or an animation that plays in browsers."""

import io
import math
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Real, UInt8

from sarsplat.data import new_folder, write_bytes, write_tiff
from sarsplat.data.files import plain_os_errors
from sarsplat.data.folders import Recognises
from sarsplat.errors import SarsplatError, counted
from sarsplat.extras import install_command
from sarsplat.geometry import ImageGrid, View
from sarsplat.geometry.view import seen_alike
from sarsplat.names import Swept
from sarsplat.report.figure import nice
from sarsplat.report.images import Look, decibel_png, target_window
from sarsplat.report.sheet import contact_sheet

if TYPE_CHECKING:
    from PIL import ImageFont

Frame = UInt8[np.ndarray, "height width"]
Palette = UInt8[np.ndarray, "256 3"]

SHEET = "contact-sheet.png"
"""The file that marks a folder of rendered images."""

ANIMATIONS: dict[str, Recognises] = {
    ".mp4": lambda head, _: head[4:8] == b"ftyp",
    ".gif": lambda head, _: head.startswith(b"GIF8"),
    ".webp": lambda head, _: head.startswith(b"RIFF") and head[8:12] == b"WEBP",
}
IMAGES: dict[str, Recognises] = {
    ".png": lambda head, _: head.startswith(b"\x89PNG"),
    ".tif": lambda head, _: head.startswith((b"II*\0", b"MM\0*")),
}
"""Suffixes of animations and of single images, and tests that recognise such files."""

FILES = {**ANIMATIONS, **IMAGES}
"""All suffixes of files; other names are folders."""

# Pixels.
_SIDE, _LARGEST = 480, 1920  # limits of the picture's longer side
_NARROWEST = 440  # minimum width: room for the text below
_FOOT, _LINE, _TEXT, _MARGIN = 30, 20, 14, 10
_BAR = (64, 6)  # width and height of the decibel scale

_INK = 190  # shade of text and lines, darker than bright echoes
_GIF_STEP = 4  # shades merged into one, invisibly, which halves the file
_SHORTEST_MS = 20  # minimum duration of a frame: browsers slow shorter ones down


@dataclass(frozen=True)
class Rendered:
    """Rendered images of β⁰ (linear power) with their views and pixels, and how to show them."""

    images: Float32[np.ndarray, "v rows columns"]
    views: list[View]
    grid: ImageGrid
    look: Look

    def around_target(self) -> "Rendered":
        """Crop all images to the target; unchanged if they show ground."""
        rows, columns = target_window(self.images, self.look.peak)
        return replace(self, images=self.images[:, rows, columns], grid=self.grid.part(rows, columns))

    def write(self, out: Path, *, seconds: float, overwrite: bool) -> str:
        """Write the file or folder that `out` names (see `require_output`), never partly; return a description."""
        ending = out.suffix.lower()
        require_output(out, len(self.views))
        if ending in ANIMATIONS:
            taken = zip(self.images, self.views, strict=True)
            unusual = any(view.unusual for view in self.views)
            frames = [frame(image, view, self.grid, self.look, unusual=unusual) for image, view in taken]
            write_animation(out, frames, self.look.palette(), seconds)
            return f"{counted(len(frames), 'frame')}, {seconds:g} s, {out.stat().st_size / 1e6:.1f} MB"
        if ending in IMAGES:
            if ending == ".tif":
                write_tiff(out, self.images[0], _description(self.views[0]))
            else:
                write_bytes(out, decibel_png(self.images[0], self.look))
            return f"{self.grid.rows} × {self.grid.columns} pixels"
        with new_folder(out, overwrite, marker=SHEET) as folder:
            for view, image in zip(self.views, self.images, strict=True):
                write_tiff(folder / f"{_name(view)}.tif", image, _description(view))
                write_bytes(folder / f"{_name(view)}.png", decibel_png(image, self.look))
            write_bytes(folder / SHEET, contact_sheet(self.images, self.views, self.grid, self.look))
        return f"{counted(len(self.views), 'image')} as TIFF and PNG, and {SHEET}"


def require_output(out: Path, views: int) -> None:
    """Raise if `out` has an unknown suffix (and is no folder) or cannot hold that many views."""
    ending = out.suffix.lower()
    if ending not in FILES and re.fullmatch(r"\.[a-z]{2,5}\d?", ending) and not out.is_dir():
        raise SarsplatError(
            f"{out} looks like a file, but images are written to {', '.join(FILES)} files or to a folder; choose one "
            "of these endings, or a folder's name without an ending"
        )
    if ending in IMAGES and views > 1:
        raise SarsplatError(
            f"{out} holds one image but {views} views were asked for; give one view, or the name of a folder"
        )
    if ending in ANIMATIONS and views < 2:
        raise SarsplatError(f"{out} is an animation but one view was asked for; give more, or `sweep='azimuth'`")


def _description(view: View) -> str:
    return (
        f"rendered SAR image, beta0 in linear power; row 0 is near range; "
        f"azimuth {view.azimuth_deg:.6g} deg, grazing {view.grazing_deg:.6g} deg{view.unusual.replace('°', ' deg')}"
    )


def _name(view: View) -> str:
    """File name that sorts by azimuth, e.g. az030_gr17.5, with tilt and side if unusual, e.g. _tilt-5_left."""

    def digits(angle: float, width: int = 0) -> str:
        return f"{angle:0{width}.6f}".rstrip("0").rstrip(".")

    tilt = f"_tilt{digits(view.tilt_deg)}" if view.tilt_deg else ""
    left = "_left" if view.side == "left" else ""
    return f"az{digits(view.azimuth_deg, 10)}_gr{digits(view.grazing_deg, 9)}{tilt}{left}"


def asked_grid(
    own: ImageGrid, pixels: tuple[int, int] | None, spacing_m: float | None, resolution_m: float | None
) -> ImageGrid:
    """A run's grid with another size (rows, columns), spacing or resolution (m), the same in azimuth and slant range.

    Without a size, as many pixels as cover the area of the run's images.
    """
    spacing = own.spacing_m if spacing_m is None else (spacing_m, spacing_m)
    resolution = own.resolution_m if resolution_m is None else (resolution_m, resolution_m)
    changed = replace(own, spacing_m=spacing, resolution_m=resolution)
    if pixels is None:
        pixels = (
            max(1, round(own.rows * own.spacing_m[1] / changed.spacing_m[1])),
            max(1, round(own.columns * own.spacing_m[0] / changed.spacing_m[0])),
        )
    return replace(changed, rows=pixels[0], columns=pixels[1])


def sweep_views(
    swept: Swept,
    frames: int,
    training: Sequence[View],
    *,
    ends_deg: tuple[float, float] | None = None,
    other_deg: float | None = None,
) -> list[View]:
    """Views in which one angle changes and the other stays, as a seamless loop.

    The sweep goes from the first to the second of `ends_deg` and back, slower at its ends; by default, azimuths turn
    full circle and grazing angles go between the lowest and highest training view. `other_deg` is the fixed angle: by
    default the median grazing angle or the first azimuth of the training views. Tilt and side follow them
    (`seen_alike`).
    """
    if frames < 2:
        raise SarsplatError(f"a sweep of {frames} frames does not move; give at least 2")
    grazing = sorted(view.grazing_deg for view in training)
    if swept == "grazing" and ends_deg is None:
        ends_deg = grazing[0], grazing[-1]
        if ends_deg[1] - ends_deg[0] < 1:
            raise SarsplatError(
                f"all training views have the grazing angle {grazing[0]:g}°, so where the sweep begins and ends has "
                "to be given; for example --grazing 10 60"
            )
    if ends_deg is None:
        moving = [360 * k / frames for k in range(frames)]
    elif ends_deg[0] == ends_deg[1]:
        raise SarsplatError(f"the sweep begins and ends at {ends_deg[0]:g}°; give two different angles")
    else:
        first, last = ends_deg
        moving = [first + (last - first) * (1 - math.cos(2 * math.pi * k / frames)) / 2 for k in range(frames)]
    moving = [round(angle, 6) for angle in moving]  # the way back has the same angles
    if swept == "azimuth":
        stays = grazing[len(grazing) // 2] if other_deg is None else other_deg
        return [seen_alike(training, angle, stays) for angle in moving]
    stays = training[0].azimuth_deg if other_deg is None else other_deg
    return [seen_alike(training, stays, angle) for angle in moving]


# ---- animations ------------------------------------------------------------------------------------------------------
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
def _font() -> "ImageFont.FreeTypeFont | ImageFont.ImageFont":
    from PIL import ImageFont

    return ImageFont.load_default(_TEXT)


def _by_pillow(kind: str, frames: Sequence[Frame], palette: Palette, durations_ms: list[int]) -> bytes:
    """GIF, of fewer shades, or WEBP."""
    from PIL import Image

    if kind == "GIF":
        first, *others = (Image.fromarray(frame // _GIF_STEP * _GIF_STEP) for frame in frames)
        for picture in (first, *others):
            picture.putpalette(palette.tobytes())
    else:
        first, *others = (Image.fromarray(palette[frame]) for frame in frames)
    buffer = io.BytesIO()
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


def write_animation(path: Path, frames: Sequence[Frame], palette: Palette, seconds: float) -> None:
    """Write frames as an animation that takes `seconds` and loops; of .mp4, the player decides if it loops.

    Frames have even sides and index into the palette. Raise if they are too many a second, or a package is missing.
    """
    if not _SHORTEST_MS * len(frames) / 1000 <= seconds < 3600:
        raise SarsplatError(
            f"an animation of {counted(len(frames), 'frame')} cannot take {seconds:g} s; give less than an hour, "
            f"and at most {1000 // _SHORTEST_MS} frames a second"
        )
    ends_ms = 10 * np.round(100 * seconds * np.arange(len(frames) + 1) / len(frames)).astype(int)  # GIF counts 10 ms
    durations_ms = np.diff(ends_ms).tolist()
    kind = path.suffix[1:].upper()
    encoded = _mp4(frames, palette, durations_ms) if kind == "MP4" else _by_pillow(kind, frames, palette, durations_ms)
    write_bytes(path, encoded)
