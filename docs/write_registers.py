"""Write registers and spills of CUDA kernels, as reported by NVRTC, into concepts/engines.md; needs no GPU."""

from __future__ import annotations

import hashlib
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fill_block import fill_block

from sarsplat.renderer.engines import nvrtc
from sarsplat.renderer.engines.nvrtc import Nvrtc, sources

PAGE = Path(__file__).parent / "concepts" / "engines.md"
ARCHITECTURES = ("sm_75", "sm_80", "sm_90", "sm_120")

_KERNEL = re.compile(r"properties for (\w+)\s.*?(\d+) bytes spill stores.*?Used (\d+) registers", re.DOTALL)


def digest() -> str:
    """Digest of everything that the table depends on."""
    programs = [Path(path).read_text(encoding="utf-8") for path in (__file__, nvrtc.__file__)]
    return hashlib.sha256(repr((Nvrtc().version, sources(), programs)).encode()).hexdigest()[:16]


def registers(architecture: str) -> dict[str, str]:
    """Registers and spilled bytes of a thread, by kernel."""
    compiler = Nvrtc()
    compiler.compile(sources(), architecture, "--ptxas-options=-v")
    kernels = _KERNEL.findall(compiler.log)
    return {name: count if spilled == "0" else f"{count}, {spilled} B spilled" for name, spilled, count in kernels}


def table() -> str:
    """Kernels in rows, architectures in columns."""
    with ThreadPoolExecutor() as pool:
        columns = list(pool.map(registers, ARCHITECTURES))
    rows = [("kernel", *ARCHITECTURES), ("---",) * (1 + len(ARCHITECTURES))]
    rows += [(f"`{name}`", *(column[name] for column in columns)) for name in sorted(columns[0])]
    lines = "".join(f"| {' | '.join(row)} |\n" for row in rows)
    return f"\nCompiled by NVRTC {Nvrtc().version}:\n\n{lines}\n<!-- of the sources {digest()} -->\n\n"


if __name__ == "__main__":
    fill_block(PAGE, "registers", table())
