"""Hatchling hook: builds the CPU engine with the `ziglang` wheel, so that no system compiler is needed."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# fp-contract: fused multiply-adds are wanted; nothing else may be reordered, or results would depend on the compiler
FLAGS = [
    *("-std=c++17", "-O3", "-g0", "-fPIC", "-fvisibility=hidden", "-fno-exceptions", "-fno-rtti", "-fno-sanitize=all"),
    *("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-Wall", "-Wextra", "-Wno-psabi"),
]
# name, lanes of a vector, flags
X86 = (
    ("base", 4, ()),
    ("avx2", 8, ("-mcpu=x86_64_v3",)),
    ("avx512", 16, ("-mcpu=x86_64_v4", "-mprefer-vector-width=512")),
)


class EngineBuildHook(BuildHookInterface):
    """Compiles `renderer/csrc` into `renderer/_engine.so`; up to date builds are kept."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        package = Path(self.root) / "src" / "sarsplat" / "renderer"
        machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
        library = package / "_engine.so"
        sources = [*(package / "csrc").glob("*.cpp"), *(package / "csrc").glob("*.h")]  # the rest is CUDA's
        newest = max(path.stat().st_mtime for path in [*sources, Path(__file__)])
        if not library.exists() or library.stat().st_mtime < newest:
            self.app.display_info("sarsplat: compiling the CPU engine (about a minute the first time)")
            compile_engine(package / "csrc", library, machine)
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{_platform_tag(machine)}"


def _platform_tag(machine: str) -> str:
    if sys.platform == "linux":
        return f"manylinux_2_28_{machine}"
    if sys.platform == "darwin":
        return f"macosx_11_0_{'arm64' if machine == 'aarch64' else machine}"
    return "win_amd64"


def compile_engine(sources: Path, library: Path, machine: str) -> None:
    """Compile every instruction set of `machine` and link one shared library with a plain C ABI."""
    system = {"linux": "linux-gnu.2.28", "darwin": "macos.11.0"}.get(sys.platform, "windows-gnu")
    compiler = [sys.executable, "-m", "ziglang", "c++", "-target", f"{machine}-{system}", *FLAGS]
    levels = X86 if machine == "x86_64" else (("base", 4, ()),)
    with tempfile.TemporaryDirectory() as folder:
        jobs = [
            (name, "engine.cpp", [*flags, f"-DSG_ISA={name}", f"-DSG_WIDTH={width}"]) for name, width, flags in levels
        ]
        jobs += [(name, f"{name}.cpp", []) for name in ("dispatch", "layout", "parallel")]

        def compile_one(job: tuple[str, str, list[str]]) -> None:
            name, source, flags = job
            subprocess.check_call([*compiler, *flags, "-c", str(sources / source), "-o", f"{folder}/{name}.o"])

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(compile_one, jobs))
        objects = sorted(str(path) for path in Path(folder).glob("*.o"))
        linked = Path(folder) / "engine.so"
        subprocess.check_call([*compiler, "-shared", "-s", *objects, "-o", str(linked)])
        temporary = library.with_suffix(".tmp")
        temporary.write_bytes(linked.read_bytes())
        temporary.replace(library)


if __name__ == "__main__":
    render = Path(__file__).parent / "src" / "sarsplat" / "renderer"
    compile_engine(render / "csrc", render / "_engine.so", platform.machine())
