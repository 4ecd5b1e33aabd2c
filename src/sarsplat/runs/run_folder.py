"""Storage of runs of any method, in a folder or in memory, and their readable names, all without torch.

Runs are named by their folders; hashed folders of sweeps by dataset and differing settings.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NotRequired, TypedDict

import msgspec
import numpy as np
from jaxtyping import Float32, Real

from sarsplat.data import read_json, read_points_ply, read_versioned_json, write_json
from sarsplat.data.files import open_file, plain_os_errors
from sarsplat.data.header import PlaceHeader
from sarsplat.errors import SarsplatError, counted
from sarsplat.settings.record import dotted
from sarsplat.threads import decode

if TYPE_CHECKING:
    from sarsplat.learning.snapshot import Snapshot

SCHEMA = "sarsplat-run"
SCHEMA_VERSION = 4
HEADER = "config.json"

CHECKPOINTS = "checkpoints"
_MAX_CHECKPOINTS = 2

LOG = "metrics.jsonl"
_MAX_LOG_BYTES = 1 << 22  # bytes; a training writes some tens of thousands

METRICS = "metrics.json"
POINTS = "points.ply"
ABOUT = "about.json"
"""File of `Run.about` of a finished run, read without torch."""

MESH = "mesh.ply"
"""Surface of methods that learn a mesh."""

_MAX_NAMED_PLACES = 3  # maximum number of missing objects whose places are named

_RESULTS = ("gaussians.ply", MESH, ABOUT, POINTS)

_Scores = dict[str, int | float | None]


class Truth(TypedDict):
    """Surface that points were compared with (null: the dataset's), and their alignment with it."""

    mesh: str | None
    sha256: NotRequired[str]
    shift_m: NotRequired[tuple[float, float, float]]
    heading_deg: NotRequired[float]
    tilts_deg: NotRequired[tuple[float, float]]


class ByImage(TypedDict):
    """Scores of each image of a test set by one metric, in the dataset's order."""

    metric: str
    scores: list[float | None]


class Metrics(TypedDict):
    """Content of `metrics.json`: scores by test set, surface or baseline, and by metric."""

    images: dict[str, _Scores]
    by_image: NotRequired[dict[str, ByImage]]
    points: dict[str, _Scores]
    mesh: dict[str, _Scores]
    capon: NotRequired[dict[str, _Scores]]
    baselines: dict[str, dict[str, _Scores]] | None
    truth: NotRequired[Truth]
    masks: NotRequired[str | None]
    time_s: float | None
    undetermined: NotRequired[float | None]
    missing: NotRequired[list[list[float]] | None]
    seed: int
    method: NotRequired[str]
    parameters: dict[str, int | float]
    definitions: dict[str, str]
    reasons: dict[str, str]


def left_open(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Describe undetermined heights and missing objects; title → text."""
    words = {}
    if isinstance(share := metrics.get("undetermined"), float):
        words["left open"] = f"heights of {share:.0%} of the surface, inside uniform areas"
    if places := metrics.get("missing"):
        where = "; ".join(", ".join(f"{value:.1f}" for value in place) for place in places[:_MAX_NAMED_PLACES])
        more = "; …" if len(places) > _MAX_NAMED_PLACES else ""
        words["missing"] = (
            f"{counted(len(places), 'place')} where images show what points lack: ({where}{more}) m; a "
            "larger --target-box, or --points.clusters bright, may keep it"
        )
    return words


class Header(msgspec.Struct, forbid_unknown_fields=True):
    schema: str
    schema_version: int
    dataset: str | None
    dataset_fingerprint: str
    config: dict[str, Any]
    method: str
    target: str = ""
    trained_on: str = ""
    """Device of the training, "cpu" or "cuda"; "" if unknown."""
    place: PlaceHeader | msgspec.UnsetType = msgspec.UNSET
    """Georeference of the scene's origin; absent if unknown."""


class LogLine(msgspec.Struct, frozen=True, omit_defaults=True):
    """Line of a training's log; `gaussians` is the number of them, None for methods without."""

    iteration: Annotated[int, msgspec.Meta(ge=0, le=10**9)]
    seconds: Annotated[float, msgspec.Meta(ge=0, le=1e10)]
    loss: Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]
    gaussians: Annotated[int, msgspec.Meta(ge=0, le=10**9)] | None = None


@dataclass(frozen=True)
class TrainingState:
    """Progress of a training."""

    done: int
    """Iterations of the newest checkpoint."""
    planned: int
    """Iterations of the settings; `done` for Gaussians trained elsewhere."""
    has_results: bool
    """True if points have been extracted."""

    @property
    def trained(self) -> bool:
        """True if all iterations are done."""
        return self.done >= self.planned

    @property
    def finished(self) -> bool:
        """True if all iterations are done and points extracted."""
        return self.trained and self.has_results

    def __str__(self) -> str:
        if self.has_results and not self.done:
            return "finished, but its checkpoint is missing, so it can be neither rendered nor continued"
        if not self.trained:
            return f"unfinished, {self.done:,} of {self.planned:,} iterations"
        return "finished" if self.has_results else "trained, but its points have not been extracted"


@dataclass
class InMemory:
    """Storage of a run without a folder."""

    snapshot: "Snapshot"
    history: list[LogLine]
    metrics: Metrics | None = None
    path: ClassVar[None] = None
    points: ClassVar[None] = None
    checkpoint_path: ClassVar[None] = None

    def keep(self, metrics: Metrics) -> None:
        self.metrics = metrics


@dataclass(frozen=True)
class RunFolder:
    """Storage of a run as files, read anew by each property."""

    path: Path

    @property
    def snapshot(self) -> "Snapshot":
        """Newest checkpoint."""
        if (checkpoint := self.checkpoint_path) is None:
            raise SarsplatError(f"{self.path} holds no checkpoint; reconstruct it again with overwrite=True")
        from sarsplat.learning.snapshot import Snapshot  # here: it needs torch

        return Snapshot.load(checkpoint)

    @property
    def header(self) -> Header:
        return read_header(self.path)

    @property
    def checkpoint_path(self) -> Path | None:
        return next(reversed(self._checkpoints()), None)

    def _checkpoints(self) -> list[Path]:
        """Return the checkpoints with a training's file names, newest last."""
        files = (self.path / CHECKPOINTS).glob("*.safetensors")
        return sorted((file for file in files if re.fullmatch(r"\d{8,}", file.stem)), key=lambda file: int(file.stem))

    def save(self, snapshot: "Snapshot") -> None:
        """Add a checkpoint and remove all but the newest two."""
        folder = self.path / CHECKPOINTS
        with plain_os_errors("write", folder):
            folder.mkdir(parents=True, exist_ok=True)
        snapshot.save(folder / f"{snapshot.iteration:08d}.safetensors")
        with plain_os_errors("write", folder):
            for old in self._checkpoints()[:-_MAX_CHECKPOINTS]:
                old.unlink()

    @property
    def log_path(self) -> Path:
        return self.path / LOG

    @property
    def history(self) -> list[LogLine]:
        """Lines of the log up to the first damaged one; [] without a file. Raise if longer than 4 MiB."""
        path = self.log_path
        if not path.is_file():
            return []
        with open_file(path) as file:
            data = file.read(_MAX_LOG_BYTES + 1)
        if len(data) > _MAX_LOG_BYTES:
            raise SarsplatError(f"{path} is longer than {_MAX_LOG_BYTES} bytes, which no training produces; remove it")
        history: list[LogLine] = []
        for line in data.splitlines():
            try:
                history.append(decode(line, LogLine))
            except (ValueError, RecursionError):
                break
        return history

    @property
    def state(self) -> TrainingState:
        settings, newest = self.header.config, self.checkpoint_path
        done = 0 if newest is None else int(newest.stem)
        planned = settings.get("iterations")
        return TrainingState(done, planned if isinstance(planned, int) else done, (self.path / POINTS).is_file())

    @property
    def points(self) -> tuple[Float32[np.ndarray, "p 3"], dict[str, Real[np.ndarray, " p"]]] | None:
        """Positions and other columns of `points.ply`; None without the file."""
        return read_points_ply(self.path / POINTS) if (self.path / POINTS).is_file() else None

    def results(self) -> dict[str, bytes]:
        """Return the files made from the newest checkpoint: name → content."""
        with plain_os_errors("read", self.path):
            return {name: (self.path / name).read_bytes() for name in _RESULTS if (self.path / name).is_file()}

    def remove_results(self) -> None:
        """Remove the files made from the newest checkpoint."""
        with plain_os_errors("write", self.path):
            for name in (*_RESULTS, METRICS, "report/index.html"):
                (self.path / name).unlink(missing_ok=True)

    @property
    def metrics(self) -> Metrics | None:
        return read_json(self.path / METRICS, Metrics) if (self.path / METRICS).is_file() else None

    def keep(self, metrics: Metrics) -> None:
        """Write the scores."""
        write_json(self.path / METRICS, metrics)


def read_header(path: Path) -> Header:
    """Read the header of a run's folder; raise if it is missing or not of this version."""
    header = path / HEADER
    if not header.is_file():
        if (path / "dataset.json").is_file():
            run = f"{path}-run"
            made = f"such as {run}" if Path(run).exists() else f"which `sarsplat reconstruct {path} --out {run}` makes"
            raise SarsplatError(f"{path} is a dataset, not a run; give a run of it, {made}")
        what = f"is no folder with {HEADER}, so it is not a run" if path.exists() else "does not exist"
        raise SarsplatError(f"{path} {what}; make one with `sarsplat reconstruct DATASET --out DIR`")
    remedy = "give a run of this version, or reconstruct it again with overwrite=True"
    return read_versioned_json(header, Header, schema=SCHEMA, version=SCHEMA_VERSION, remedy=remedy)


def require_replaceable(out: Path) -> None:
    """Raise if a folder's `config.json` is another program's."""
    header = out / HEADER
    if header.is_file():
        data = read_json(header, dict[str, Any])
        if data.get("schema") != SCHEMA:
            raise SarsplatError(f"{header} is not the header of a run, so it will not be replaced; choose another name")


def log_text(lines: Iterable[LogLine]) -> bytes:
    """Encode log lines as in `metrics.jsonl`."""
    return b"".join(msgspec.json.encode(line) + b"\n" for line in lines)


def is_hashed(folder: Path) -> bool:
    """Return whether a run's folder has a hash for a name, as in sweeps."""
    return re.fullmatch(r"[0-9a-f]{16}", folder.name) is not None


def names_of(folders: Sequence[Path]) -> list[str]:
    """Return names of runs: folder names, or distinguishing names of hashed folders; paths if these coincide."""
    hashed = [folder for folder in folders if is_hashed(folder)]
    values_of_kind = dict(zip(hashed, distinguished([read_header(folder) for folder in hashed]), strict=True))
    names = [values_of_kind.get(folder, folder.absolute().name) for folder in folders]
    return names if len({*names}) == len(names) else [str(folder) for folder in folders]


def distinguished(headers: Sequence[Header], with_method: bool = True) -> list[str]:
    """Name each run by dataset, differing method, preset and settings, and seed.

    Settings are compared between runs of one dataset, method and preset, as others differ in most. A section that other
    runs lack is named without its settings.
    """
    methods = {header.method for header in headers}
    presets = {header.config["preset"] for header in headers if "preset" in header.config}  # only of sar-gs
    folder_counts = Counter(Path(path).name for path in {_dataset(header) for header in headers})
    kind_counts = Counter(map(_kind, headers))
    values = defaultdict[tuple[tuple[str, str, str], str], list[str]](list)  # kind, setting → values
    for header in headers:
        for setting, value in dotted(header.config):
            values[_kind(header), setting].append(str(value))
    names = []
    for header in headers:
        path = Path(_dataset(header))
        words = [(path.name if folder_counts[path.name] == 1 else _dataset(header)) or "images in memory"]
        words += [header.method] if with_method and len(methods) > 1 else []
        words += [header.config["preset"]] if len(presets) > 1 and "preset" in header.config else []
        settings = ((name, value) for name, value in dotted(header.config) if name not in ("preset", "seed"))
        for setting, value in settings:
            given, (section, dot, _) = values[_kind(header), setting], setting.partition(".")
            some_lack_it = len(given) < kind_counts[_kind(header)]
            if len({*given}) > 1 or (some_lack_it and not dot):
                words.append(f"{setting} {value}")
            elif some_lack_it and section not in words:
                words.append(section)
        words += [f"seed {header.config['seed']}"] if "seed" in header.config else []
        names.append(", ".join(words))
    return names


def _kind(header: Header) -> tuple[str, str, str]:
    return _dataset(header), header.method, str(header.config.get("preset"))


def _dataset(header: Header) -> str:
    return header.dataset or ""
