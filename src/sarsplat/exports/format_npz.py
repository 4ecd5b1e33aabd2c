"""`.npz`: all that was learned as numpy arrays, with what they mean; nothing in it is pickled."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from sarsplat.data import write_bytes
from sarsplat.exports.format import Format
from sarsplat.names import Colour
from sarsplat.runs import Run

_DESCRIPTION = "description"
_MEANING = {
    "means": "centres of the Gaussians, world frame, m",
    "quaternions": "their orientations, (w, x, y, z), to be normalised",
    "scales": "standard deviations along their own axes, m",
    "optical_depth": "two-way optical depth through their centres",
    "scattering": "parameters of their law of scattering",
    "points": "points of the surface, world frame, m",
    "normals": "unit normals of the points",
    "points_gamma0": "gamma0 of the points, linear",
}


def _write(run: Run, path: Path, _: Colour) -> None:
    arrays: dict[str, Any] = {}
    law = None
    if (gaussians := run.gaussians) is not None:
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in gaussians.tensors().items()}
        law = {"kind": gaussians.scattering.kind, **gaussians.scattering.settings()}
    arrays |= {"points": run.points, "normals": run.normals}
    if run.points_gamma0 is not None:
        arrays["points_gamma0"] = run.points_gamma0
    description = {
        "made_by": "sarsplat",
        "method": run.method,
        "arrays": {name: _MEANING[name] for name in arrays},
        "scattering_law": law,
        "frame": "x nose, y left, z up, ground at z = 0",
    }
    content = io.BytesIO()
    np.savez(content, **({_DESCRIPTION: np.array(json.dumps(description))} | arrays))
    write_bytes(path, content.getvalue())


FORMAT = Format(
    writers={"everything": _write},
    opened_with={"everything": 'numpy.load; json.loads(str(file["description"])) says what is in it'},
    recognises=lambda head, _: head.startswith(b"PK\x03\x04") and head[30:].startswith(_DESCRIPTION.encode()),
)
