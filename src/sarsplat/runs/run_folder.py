"""What files in a run's folder hold, whatever its method: its settings and its scores."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NotRequired, TypedDict

import msgspec

from sarsplat.data import read_json, read_versioned_json
from sarsplat.errors import SarsplatError

SCHEMA = "sarsplat-run"
SCHEMA_VERSION = 4
HEADER = "config.json"

POINTS = "points.ply"
ABOUT = "about.json"
"""What `Run.about` says of a finished run, for those who will not wait for torch."""

MESH = "mesh.ply"
"""The surface, of methods that learn one as such."""

_Scores = dict[str, float | None]


class Truth(TypedDict):
    """What surface the points were compared with: its file, unless it is the dataset's, and how they were moved."""

    mesh: str | None
    shift_m: NotRequired[tuple[float, float, float]]
    heading_deg: NotRequired[float]


class ByImage(TypedDict):
    """One metric of each image of a test set, in the dataset's order."""

    metric: str
    scores: list[float | None]


class Metrics(TypedDict):
    """What `metrics.json` holds: scores by test set, surface or baseline, and by metric."""

    images: dict[str, _Scores]
    by_image: NotRequired[dict[str, ByImage]]
    points: dict[str, _Scores]
    mesh: dict[str, _Scores]
    baselines: dict[str, dict[str, _Scores]] | None
    truth: NotRequired[Truth]
    masks: NotRequired[str | None]
    time_s: float | None
    seed: int
    method: NotRequired[str]
    parameters: dict[str, float]
    definitions: dict[str, str]
    reasons: dict[str, str]


class Header(msgspec.Struct, forbid_unknown_fields=True):
    """What `config.json` holds."""

    schema: str
    schema_version: int
    dataset: str | None
    dataset_fingerprint: str
    config: dict[str, Any]
    method: str
    target: str = ""
    """What its dataset shows."""


def read_header(path: Path) -> Header:
    """The header of a run's folder.

    Raises
    ------
    SarsplatError
        If it is missing, or not a run of this version.
    """
    header = path / HEADER
    if not header.is_file():
        if (path / "dataset.json").is_file():
            usual = path.with_name(f"{path.name}-run")
            made = (usual / HEADER).is_file()
            one = f"such as {usual}" if made else f"which `sarsplat reconstruct {path} --out {usual}` makes"
            raise SarsplatError(f"{path} is a dataset, not a run; give a run of it, {one}")
        what = "does not exist" if not path.exists() else f"holds no {HEADER}, so it is not a run"
        raise SarsplatError(f"{path} {what}; make one with `sarsplat reconstruct DATASET --out {path}`")
    data = read_json(header, dict[str, Any])
    version = data.get("schema_version")
    if data.get("schema") == SCHEMA and isinstance(version, int) and version < SCHEMA_VERSION:
        raise SarsplatError(f"{path} was written by an older version; reconstruct it again with overwrite=True")
    return read_versioned_json(
        header, Header, schema=SCHEMA, version=SCHEMA_VERSION, remedy="give a run, or reconstruct it again"
    )


def read_metrics(path: Path) -> Metrics | None:
    """The scores in a run's folder, if it was evaluated."""
    return read_json(path / "metrics.json", Metrics) if (path / "metrics.json").is_file() else None


def require_replaceable(out: Path) -> None:
    """Refuse to overwrite a folder that is not a run, of whatever version: many programs keep a `config.json`."""
    header = out / HEADER
    if header.is_file():
        data = read_json(header, dict[str, Any])
        if data.get("schema") != SCHEMA:
            raise SarsplatError(f"{header} is not the header of a run, so it will not be replaced; choose another name")
