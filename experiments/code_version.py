"""Which code made a result: a digest of everything that a score depends on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from sarsplat.reconstruction.methods import module_of
from sarsplat.sweeps.address import SCORING, TRAINING, code, forget


def code_version(*methods: str) -> str:
    """Digest of what simulating, training by these methods and scoring run, as it is on the disk now."""
    forget()
    return code(("sarsplat.cli.simulate", TRAINING, SCORING, *map(module_of, methods)), "cpu")[:10]


def digest(content: Mapping[str, Any]) -> str:
    """Name of a file or folder for what it holds."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:20]
