"""One run of a sweep: its dataset, method, settings and seed, and its content address.

The address is a hash of the run's data, its settings and the source code that makes it.
"""

import ast
import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any, ClassVar, cast

import msgspec
import numpy as np

from sarsplat.data import Dataset, read_dataset, read_masks
from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.cpu import LIBRARY
from sarsplat.runs.methods import method_named, module_of
from sarsplat.sweeps.plan import Plan

NAMES = ("part", "dataset", "method", "preset")
"""Labels that are not settings."""

_NO_RESULT = ("preset", "checkpoint_every")  # settings that change no result

TRAINING, SCORING = "sarsplat.runs.reconstruction", "sarsplat.evaluation.evaluate"
"""Root modules of training and scoring; a method adds its own module."""

_SETTLED = "sarsplat.settings.presets"  # module left out of the code's digest: its content is in the settings
_MESSAGE_CALLS = ("warn", "note", "stage", "progress")  # functions whose texts change no result

_DIGITS = 16


class Cell(msgspec.Struct, frozen=True):
    """One run: a dataset, a method, settings and a seed."""

    work: ClassVar[str] = "sarsplat.sweeps.work:RUN"
    """Name of the executors' `Work`."""

    dataset: str
    """The dataset's folder."""
    method: str
    """Name of the method."""
    config: dict[str, Any]
    """All settings, including the seed."""
    masks: str | None
    mesh: str | None
    align: str
    reports: bool
    device: str
    """As in `Plan`; `masks` includes those that the method learns from."""
    labels: dict[str, Any]
    """Labels in tables: dataset, method, preset, and each setting that the plan names."""
    seed: int
    fingerprint: str
    recipe: str
    """Digest of data, method and settings."""
    code: str
    """Digest of the training's code."""
    scoring: str
    """Digest of the scoring's code and options."""

    def words(self, names: Collection[str]) -> str:
        """Description in one line, from the labels of these names and the seed."""
        chosen = {name: value for name, value in self.labels.items() if name in names}
        labels = [f"{value}" if name in NAMES else f"{name} {value}" for name, value in chosen.items()]
        return ", ".join([*labels, f"seed {self.seed}"])

    @property
    def address(self) -> str:
        """Name of its run and row: a hash of data, settings and training code."""
        return digest([self.recipe, self.code])


def cells_of(plan: Plan, base: Path) -> list[Cell]:
    """List every run of a plan, in its order; patterns are below the folder `base`.

    Raises if a dataset, method, preset or setting does not exist, or a value is out of range.
    """
    return [cell for part in plan.each_part() for cell in _cells(part.at(base), base)]


def _cells(plan: Plan, base: Path) -> Iterator[Cell]:
    for folder, name in plan.folders(base).items():
        dataset = None
        try:
            dataset = read_dataset(folder)
            fingerprint = dataset.fingerprint()
        except SarsplatError as error:  # the run fails with it when it is tried
            fingerprint = f"{folder}: {error}"
        for method in plan.each_method():
            yield from _of_dataset(plan, folder, name, dataset, fingerprint, *method)


def _of_dataset(
    plan: Plan,
    folder: Path,
    name: str,
    dataset: Dataset | None,
    fingerprint: str,
    method: str,
    settings: Mapping[str, Any],
) -> Iterator[Cell]:
    kind = method_named(method)
    masks = plan.masks or (str(folder / "masks") if (folder / "masks").is_dir() else None)
    learned_from = ""
    if "masks" in kind.takes and masks is not None and dataset is not None:
        learned_from = _fingerprint_of_masks(Path(masks), dataset)
    code = code_of(method, plan.device)
    scoring = digest([scoring_code(), masks, plan.mesh, plan.align])
    where = f"settings of {method}{f' in {plan.name}' if plan.name else ''}"
    preset_named = cache(partial(kind.preset, dataset=cast(Dataset, dataset)))  # may run a trial
    for preset, chosen in plan.each_choice(settings):
        labels = {"dataset": name, "method": method, "preset": preset, **chosen}
        if plan.name:
            labels = {"part": plan.name, **labels}
        base = None if dataset is None else preset_named(preset).with_settings(chosen, where)
        for seed in plan.seeds:
            config = {**labels, "seed": seed} if base is None else replace(base, seed=seed).as_dict()
            decisive = {one: value for one, value in config.items() if one not in _NO_RESULT}
            recipe = digest([fingerprint, method, decisive, plan.device, learned_from])
            yield Cell(
                dataset=str(folder),
                method=method,
                config=config,
                masks=masks,
                mesh=plan.mesh,
                align=plan.align,
                reports=plan.reports,
                device=plan.device,
                labels=labels,
                seed=seed,
                fingerprint=fingerprint,
                recipe=recipe,
                code=code,
                scoring=scoring,
            )


def _fingerprint_of_masks(folder: Path, dataset: Dataset) -> str:
    try:
        masks = read_masks(folder, dataset, ("train",))
    except SarsplatError as error:
        return str(error)
    return digest([np.stack([*masks.values()]).tobytes().hex(), sorted(masks)])


# ---- the code of a run ----
def digest(content: Any) -> str:
    """Hash of JSON data, 16 hexadecimal digits, independent of the order of keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:_DIGITS]


def code_of(method: str, device: str) -> str:
    """Digest of the project's (and plugin's) code that a training by this method runs."""
    return code((TRAINING, module_of(method)), device)


def scoring_code() -> str:
    """Digest of the project's code that scoring runs."""
    return code((SCORING,), "cpu")


@cache
def code(roots: tuple[str, ...], device: str) -> str:
    """Digest of modules, of all that they import, and of the device's engine, cached for the process.

    Comments, docstrings and the texts of errors and warnings do not count.
    """
    sources = {name: _statements(path) for name, path in imported_by(roots).items()}
    engine = [LIBRARY] if device == "cpu" else sorted((LIBRARY.parent / "csrc").glob("*.[ch]*"))
    parts = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in engine if path.is_file()}
    return digest([sources, parts])


def imported_by(roots: Iterable[str]) -> dict[str, Path]:
    """Files, by module name, of the roots and of all that they import from sarsplat and their own packages.

    Source is parsed, not executed; imports inside functions count. A package that discovers its modules counts as
    importing all of them, except methods: only those among the roots count.
    """
    found: dict[str, Path] = {}
    waiting = list(roots)
    packages = {"sarsplat", *(root.partition(".")[0] for root in waiting)}
    while waiting:
        name = waiting.pop()
        if name in (*found, _SETTLED) or name.partition(".")[0] not in packages or (path := _file(name)) is None:
            continue
        found[name] = path
        if "." in name:
            waiting.append(name.rpartition(".")[0])
        waiting += _imports(name, path)
    return dict(sorted(found.items()))


@cache
def _file(name: str) -> Path | None:
    try:
        spec = find_spec(name)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


@cache
def _nodes(path: Path) -> Sequence[ast.AST]:
    return [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]


@cache
def _imports(name: str, path: Path) -> list[str]:
    found: list[str] = []
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            found += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = _absolute(node, name, path)
            lazy = _lazy(module)
            found += (lazy.get(alias.name, f"{module}.{alias.name}") for alias in node.names)
            found.append(module)
        elif isinstance(node, ast.Call):
            found += _discovered(node, name, path)
    return found


def _absolute(node: ast.ImportFrom, name: str, path: Path) -> str:
    package = name if path.name.startswith("__init__") else name.rpartition(".")[0]
    return resolve_name("." * node.level + (node.module or ""), package)


@cache
def _lazy(package: str) -> Mapping[str, str]:
    """Module of each name that a package loads lazily, from its stub."""
    file = _file(package) if package.partition(".")[0] == "sarsplat" else None
    if file is None or not (stub := file.with_suffix(".pyi")).is_file():
        return {}
    found = (node for node in _nodes(stub) if isinstance(node, ast.ImportFrom))
    return {alias.name: _absolute(node, package, stub) for node in found for alias in node.names}


def _discovered(call: ast.Call, name: str, path: Path) -> Iterator[str]:
    """Modules that a call discovers by folder and name."""
    called = call.func.id if isinstance(call.func, ast.Name) else ""
    if called in ("classes_in", "import_module") and path.name == "__init__.py":
        yield from _modules(name)
    elif called == "discover":
        words = [one.value for one in call.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        for package in words[:1] if words[1:2] != ["method_"] else []:  # of methods, the roots alone count
            yield from (module for module in _modules(package) if module.rpartition(".")[2].startswith(words[1]))


def _modules(package: str) -> Iterator[str]:
    if (file := _file(package)) is not None:
        yield from (f"{package}.{path.stem}" for path in file.parent.glob("*.py") if path.stem != "__init__")


@cache
def _statements(path: Path) -> str:
    """Source of a file without comments, docstrings and messages."""
    _drop_texts(_nodes(path))
    return ast.unparse(_nodes(path)[0])


def _drop_texts(nodes: Sequence[ast.AST]) -> None:
    """Remove docstrings, and the texts of errors and warnings, in place."""
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [one for one in node.body if not _is_text(one)] or [ast.Pass()]
        elif isinstance(node, ast.Raise) or (isinstance(node, ast.Call) and _called(node) in _MESSAGE_CALLS):
            for part in ast.walk(node):
                if isinstance(part, ast.Constant) and isinstance(part.value, str):
                    part.value = ""


def _called(call: ast.Call) -> str:
    name = getattr(call.func, "id", None) or getattr(call.func, "attr", "")
    return str(name)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
