"""Draw which folder, and which file, of the package imports which, downwards: docs/images/imports.png."""

from __future__ import annotations

import io
import sys
from collections import defaultdict
from collections.abc import Mapping
from graphlib import TopologicalSorter
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from PIL import Image

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))
from import_graph import graph  # noqa: E402
from sarsplat.colours import colormap  # noqa: E402

PICTURE = HERE / "images" / "imports.png"
Edges = dict[str, set[str]]


def room_of(module: str) -> str:
    """The folder of a file; of one that lies in none, such as `errors`, the file itself."""
    return module.partition(".")[0]


def between_rooms(edges: Edges) -> Edges:
    """Which room imports which."""
    rooms: Edges = defaultdict(set)
    for module, others in edges.items():
        rooms[room_of(module)] |= {room_of(other) for other in others} - {room_of(module)}
    return rooms


def levels(edges: Edges) -> dict[str, int]:
    """Longest chain of imports down from each module: 0 if it imports nothing."""
    found: dict[str, int] = {}

    def level(name: str) -> int:
        if name not in found:
            found[name] = 1 + max((level(other) for other in edges[name]), default=-1)
        return found[name]

    for name in edges:
        level(name)
    return found


def draw(axes: Axes, edges: Edges, colours: Mapping[str, object], size: float, *, names: bool) -> None:
    """Draw a row for each level, with arrows from importing to imported modules."""
    rows: dict[int, list[str]] = defaultdict(list)
    for name, level in sorted(levels(edges).items(), key=lambda item: (room_of(item[0]), item[0])):
        rows[level].append(name)
    places = {name: ((k + 0.5) / len(row), float(level)) for level, row in rows.items() for k, name in enumerate(row)}
    for name, others in edges.items():
        for other in others:
            (x0, y0), (x1, y1) = places[name], places[other]
            colour = colours[room_of(name)]
            axes.annotate(
                "", (x1, y1), (x0, y0), arrowprops={"arrowstyle": "-", "color": colour, "alpha": 0.35, "lw": size / 12}
            )
    for name, (x, y) in places.items():
        if names:
            box = {"facecolor": "white", "edgecolor": colours[room_of(name)], "boxstyle": "round,pad=0.3"}
            axes.text(x, y, name, ha="center", va="center", fontsize=size, color="black", bbox=box)
        else:
            axes.plot(x, y, "o", color=colours[room_of(name)], markersize=size / 2)
    axes.set(xlim=(0, 1), ylim=(-0.6, max(rows) + 0.6))
    axes.axis("off")


def main() -> None:
    """Draw both levels, one below the other."""
    files = {name: others for name, others in graph(for_types=False).items() if name not in ("", "__main__")}
    TopologicalSorter(files).prepare()  # levels end: no files import each other
    rooms = between_rooms(files)
    ranked = sorted(rooms, key=lambda room: (levels(rooms)[room], room))
    colours = {room: colormap("turbo")(0.05 + 0.9 * k / len(ranked)) for k, room in enumerate(ranked)}
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(11, 16), height_ratios=(2, 3), layout="constrained")
    draw(top, rooms, colours, 9, names=True)
    top.set_title(f"{len(rooms)} folders and files at the root: who imports whom, downwards")
    draw(bottom, files, colours, 9, names=False)
    bottom.set_title(f"{len(files)} files, in the colours of their folders: {sum(map(len, files.values()))} imports")
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=80)
    Image.open(drawn).convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
