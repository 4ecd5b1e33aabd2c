"""Draw docs/images/cphd.png: what `import phase-history` makes of CPHD files, here of two containers and a mast.

Run as `python docs/draw_cphd.py`, or with the other figures as `make figures`. The files are made up, pulse by pulse:
every facet that the antenna sees, and every patch of ground, is a point of a random phase, without the renderer.
"""

from __future__ import annotations

import math
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import trimesh

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))

import cphds  # noqa: E402
from sarsplat.errors import SarsplatWarning  # noqa: E402
from sarsplat.importers import import_phase_history  # noqa: E402
from sarsplat.report.sheet import check_sheet  # noqa: E402

OUTPUT = HERE / "images" / "cphd.png"
BEARINGS = (10, 70, 130, 190, 250, 310)  # degrees, of the radar
SIZE, GROUND, STEP = 20.0, 0.02, 0.3  # m; γ⁰ of the ground; m between its points
BAND = (9.4e9, 9.9e9)


def scene() -> trimesh.Trimesh:
    """Two containers, one across the other's end, and a mast; m, east, north and up."""
    parts = []
    for extents, place in (
        ((6.1, 2.4, 2.6), (-1.0, 1.5, 1.3)),
        ((2.4, 6.1, 2.6), (4.5, -2.0, 1.3)),
        ((0.4, 0.4, 6.0), (-4.0, -3.5, 3.0)),
    ):
        box = trimesh.creation.box(extents)
        box.apply_translation(place)
        parts.append(box)
    joined = trimesh.util.concatenate(parts)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def points(mesh: trimesh.Trimesh, antenna: np.ndarray, rng: np.random.Generator) -> cphds.Points:
    """Scatterers visible to the antenna, with amplitudes whose squares are cross-sections up to a factor."""
    towards = antenna / np.linalg.norm(antenna)
    fine = mesh.subdivide_to_size(0.4)
    assert isinstance(fine, trimesh.Trimesh)
    cosine = fine.face_normals @ towards
    flat = np.arange(-SIZE, SIZE, STEP)
    ground = np.array([(x, y, 0.0) for x in flat for y in flat]) + rng.uniform(-0.5, 0.5, (len(flat) ** 2, 3)) * (
        STEP,
        STEP,
        0,
    )
    places = np.concatenate([fine.triangles_center[cosine > 0], ground])
    area = np.concatenate([(cosine * fine.area_faces)[cosine > 0], np.full(len(ground), GROUND * towards[2] * STEP**2)])
    hidden = mesh.ray.intersects_any(places + 0.02 * towards + (0, 0, 0.01), np.tile(towards, (len(places), 1)))
    amplitude = np.sqrt(area) * np.exp(2j * math.pi * rng.random(len(places)))
    return [(tuple(place), complex(one)) for place, one in zip(places[~hidden], amplitude[~hidden], strict=True)]


def main() -> None:
    """Write six files, import them, and draw the sheet."""
    rng, mesh = np.random.default_rng(0), scene()
    warnings.simplefilter("ignore", SarsplatWarning)  # six views leave gaps
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for index, bearing in enumerate(BEARINGS):
            antenna = cphds.arc(bearing, 4.0, 120, grazing_deg=35.0)
            made = cphds.Collection(
                antenna, domain=("FX", "TOA")[index % 2], sign=1 - 2 * (index % 3 == 0), band=BAND, swath=24.0
            )
            path = Path(folder) / f"{bearing:03d}.cphd"
            paths.append(cphds.write_cphd(path, made, points(mesh, antenna.mean(axis=0), rng)))
        dataset = import_phase_history(paths, Path(folder) / "set", size_m=SIZE, target="containers")
        OUTPUT.write_bytes(check_sheet(dataset))


if __name__ == "__main__":
    main()
