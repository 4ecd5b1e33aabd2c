"""Plugins: files with a name prefix, and entry points of other packages."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any, TypeVar

from sarsplat.errors import SarsplatError, SarsplatWarning, shown

T = TypeVar("T")


class Plugins(Mapping[str, Any]):
    """Plugins by name, searched at first use: that takes 20 ms, which help need not wait for.

    Listing the names imports nothing; `[name]` imports that plugin, or raises a SarsplatError.
    """

    def __init__(self, search: Callable[[], dict[str, EntryPoint]]) -> None:
        self._search = search
        self._loaded: dict[str, Any] = {}

    @cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        return self._search()

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __getitem__(self, name: str) -> Any:
        entry = self._entries[name]
        if name not in self._loaded:
            try:
                self._loaded[name] = entry.load()
            except Exception as error:  # third-party code
                raise SarsplatError(
                    f"the plugin {name} of {entry.group} cannot be imported from {entry.value} "
                    f"({type(error).__name__}: {shown(str(error))}); update or uninstall its package"
                ) from error
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def module(self, name: str) -> str:
        """Return the module of a plugin."""
        return self._entries[name].module

    def add(self, name: str, plugin: Any) -> None:
        """Register a plugin in this process."""
        where = f"{plugin.__module__}:{getattr(plugin, '__qualname__', type(plugin).__qualname__)}"
        self._entries[name] = EntryPoint(name, where, "")
        self._loaded[name] = plugin

    def loaded(self) -> dict[str, Any]:
        """Return all plugins that can be imported, by name; warn of the others."""
        for name in self._entries:
            try:
                self[name]
            except SarsplatError as error:
                warnings.warn(str(error), SarsplatWarning, stacklevel=2)
        return {name: self._loaded[name] for name in self._entries if name in self._loaded}


def discover(package: str, prefix: str, attribute: str, group: str, *more_packages: str) -> Plugins:
    """Return the plugins of our packages, named after their files, and of other packages, by entry points.

    Files begin with `prefix`: with `method_`, the module `method_sar_nerf` is the plugin `sar-nerf`; `attribute` names
    it in its module. Entry points are `name = "module:attribute"` in `group`; one whose name is already in use is
    ignored, with a SarsplatWarning at first use.
    """
    return Plugins(partial(_search, (package, *more_packages), prefix, attribute, group))


def classes_in(package: str, base: type[T]) -> tuple[type[T], ...]:
    """Import the modules of a package and return their classes derived from `base`, sorted by `order`."""
    modules = [import_module(f"{package}.{name}") for name in _modules(package)]
    kinds = [
        kind
        for module in modules
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, base) and kind.__module__ == module.__name__ != base.__module__
    ]
    return tuple(sorted(kinds, key=lambda kind: kind.order))  # type: ignore[attr-defined]


def _modules(package: str) -> Iterator[str]:
    spec = find_spec(package)
    return (info.name for info in iter_modules((spec and spec.submodule_search_locations) or ()))


def _search(packages: Sequence[str], prefix: str, attribute: str, group: str) -> dict[str, EntryPoint]:
    entries: dict[str, EntryPoint] = {}
    for home in packages:
        for module in _modules(home):
            if module.startswith(prefix):
                name = module.removeprefix(prefix).replace("_", "-")
                entries[name] = EntryPoint(name, f"{home}.{module}:{attribute}", group)
    for entry in entry_points(group=group):
        taken = entries.setdefault(entry.name, entry)
        if taken.value != entry.value:
            warnings.warn(
                f"the plugin {entry.name} of {group} from {entry.value} is ignored, because {taken.value} has that "
                "name; rename or uninstall one of them",
                SarsplatWarning,
                stacklevel=2,
            )
    return entries
