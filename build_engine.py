"""Hatchling hook: builds the CPU engine with the `ziglang` wheel, which needs no system compiler and builds for others.

`SARSPLAT_TARGET` names the platform of a wheel, one of `TARGETS`; without it, it is this machine's. Run as a script, it
builds the engine of this machine into the source tree; with `--here`, only for the instruction set that it has.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parent
RENDERER = ROOT / "src" / "sarsplat" / "renderer"

# fp-contract: fused multiply-adds are wanted; nothing else may be reordered, or results would depend on the compiler
FLAGS = [
    *("-std=c++17", "-O3", "-g0", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-fno-sanitize=all"),
    *("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-Wall", "-Wextra", "-Wno-psabi"),
]
BASE = ("base", 4, ())  # name, lanes of a vector, flags
X86 = (BASE, ("avx2", 8, ("-mcpu=x86_64_v3",)), ("avx512", 16, ("-mcpu=x86_64_v4", "-mprefer-vector-width=512")))


class Target(NamedTuple):
    """A platform that has an engine."""

    triple: str
    """What the compiler calls it."""
    tag: str
    """What the name of a wheel calls it."""
    levels: tuple[tuple[str, int, tuple[str, ...]], ...]
    library: str = "_engine.so"
    link: tuple[str, ...] = ()


TARGETS = {
    "linux-x86_64": Target("x86_64-linux-gnu.2.28", "manylinux_2_28_x86_64", X86),
    "linux-aarch64": Target("aarch64-linux-gnu.2.28", "manylinux_2_28_aarch64", (BASE,)),
    # its own name is written into a library of macOS, and would be the path of a temporary folder
    "macos-arm64": Target(
        "aarch64-macos.11.0", "macosx_11_0_arm64", (BASE,), link=("-Wl,-install_name,@rpath/_engine.so",)
    ),
    "windows-x86_64": Target("x86_64-windows-gnu", "win_amd64", X86, library="_engine.dll"),
}


def host() -> str | None:
    """The name of this machine's platform, or None if it has no engine."""
    system = {"darwin": "macos", "win32": "windows"}.get(sys.platform, sys.platform)
    machine = {"AMD64": "x86_64"}.get(platform.machine(), platform.machine())
    name = f"{system}-{machine}"
    return name if name in TARGETS else None


class EngineBuildHook(BuildHookInterface[Any]):
    """Adds the engine to a wheel, or to the source tree if the installation is editable."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        name = os.environ.get("SARSPLAT_TARGET") or host()
        if name is None:
            self.app.display_warning(
                f"sarsplat: there is no CPU engine for {sys.platform} on {platform.machine()}; engine='reference' works"
            )
            return
        if name not in TARGETS:
            self.app.abort(f"SARSPLAT_TARGET is {name!r}; it has to be one of {', '.join(TARGETS)}")
        target = TARGETS[name]
        library = engine(name)
        if version == "editable":
            put(library, RENDERER / target.library)
        else:
            build_data["force_include"][str(library)] = f"sarsplat/renderer/{target.library}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{target.tag}"


def engine(name: str) -> Path:
    """The engine of a target, compiled unless it is up to date."""
    library = ROOT / "build" / name / TARGETS[name].library
    sources = [*(RENDERER / "csrc").glob("*.cpp"), *(RENDERER / "csrc").glob("*.h")]  # the rest is CUDA's
    newest = max(path.stat().st_mtime for path in [*sources, Path(__file__)])
    if not library.exists() or library.stat().st_mtime < newest:
        print(f"sarsplat: compiling the CPU engine for {name} (about a minute the first time)", flush=True)
        compile_engine(TARGETS[name], library, range(1, len(TARGETS[name].levels) + 1))
    return library


def supported(target: Target) -> int:
    """The widest instruction set of this machine, counted from one, as the engine that is here says; 0 without one."""
    try:
        return ctypes.CDLL(str(RENDERER / target.library)).sg_supported_isa()
    except (OSError, AttributeError):
        return 0


def compile_engine(target: Target, library: Path, isas: Iterable[int]) -> None:
    """Compile some of a target's instruction sets and link one shared library with a plain C ABI."""
    compiler = [sys.executable, "-m", "ziglang", "c++", "-target", target.triple, *FLAGS]
    with tempfile.TemporaryDirectory() as folder:
        jobs, sets = [], ""
        for isa in isas:
            name, width, flags = target.levels[isa - 1]
            jobs.append((name, "engine.cpp", [*flags, f"-DSG_ISA={name}", f"-DSG_WIDTH={width}"]))
            sets += f"SET({isa}, {name}) "
        digest = hashlib.sha256((RENDERER / "csrc" / "api.h").read_bytes()).hexdigest()
        jobs += [("dispatch", "dispatch.cpp", [f"-DSG_SETS={sets}", f"-DSG_API={digest}"])]
        jobs += [("parallel", "parallel.cpp", [])]

        def compile_one(job: tuple[str, str, list[str]]) -> subprocess.CompletedProcess[str]:
            name, source, flags = job
            command = [*compiler, *flags, "-c", str(RENDERER / "csrc" / source), "-o", f"{folder}/{name}.o"]
            return subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            done = list(pool.map(compile_one, jobs))
        for said in dict.fromkeys(one.stderr for one in done):  # once, though it is true of every instruction set
            sys.stderr.write(said)
        for one in done:
            one.check_returncode()
        objects = sorted(str(path) for path in Path(folder).glob("*.o"))
        linked = Path(folder) / target.library
        command = [*compiler, "-shared", "-s", *target.link, *objects, "-o", str(linked)]
        done_linking = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)  # draws on a terminal
        sys.stderr.write(done_linking.stderr)
        done_linking.check_returncode()
        put(linked, library)


def put(source: Path, destination: Path) -> None:
    """Copy in one step, so that no process loads half a library."""
    destination.parent.mkdir(parents=True, exist_ok=True)
    temporary = destination.with_suffix(".tmp")
    shutil.copyfile(source, temporary)
    temporary.replace(destination)


def requirements(extras: list[str]) -> list[str]:
    """What pyproject.toml asks for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [*project["dependencies"], *(one for extra in extras for one in project["optional-dependencies"][extra])]


if __name__ == "__main__":
    if sys.argv[1:2] == ["--requirements"]:
        print(*requirements(sys.argv[2:]), sep="\n")
        sys.exit()
    if (this := host()) is None:
        sys.exit(f"there is no CPU engine for {sys.platform} on {platform.machine()}")
    target = TARGETS[this]
    try:
        if sys.argv[1:] == ["--here"] and (isa := supported(target)):
            compile_engine(target, RENDERER / target.library, [isa])
        else:
            put(engine(this), RENDERER / target.library)
    except subprocess.CalledProcessError:
        former = "; the former one stays in use" if (RENDERER / target.library).exists() else ""
        sys.exit(f"sarsplat: the engine was not built; above is what the compiler says{former}")
