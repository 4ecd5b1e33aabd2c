"""What is in the wheels of dist/, and whether this machine's works in an empty environment: `make check-wheel`.

The wheel is installed with the versions of constraints.txt, and nothing of this folder is in the way of imports. The
README's first example has to print there what the reference engine says. Needs nothing installed but `packaging`.
"""

import os
import re
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

from packaging.tags import sys_tags
from packaging.utils import parse_wheel_filename

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "sarsplat"
SOURCES = PACKAGE / "renderer" / "csrc"
MAGIC = {
    "manylinux_2_28_x86_64": ("_engine.so", b"\x7fELF", (18, b"\x3e\0")),
    "manylinux_2_28_aarch64": ("_engine.so", b"\x7fELF", (18, b"\xb7\0")),
    "macosx_11_0_arm64": ("_engine.so", b"\xcf\xfa\xed\xfe", (4, b"\x0c\0\0\x01")),
    "win_amd64": ("_engine.dll", b"MZ", (0, b"MZ")),
}
"""By platform: the engine, how its file begins, and what it holds where the processor is named."""

IMPORT_EVERYTHING = """
import importlib, pkgutil, pathlib, sys
import torch, sarsplat
from sarsplat.renderer.engines import nvrtc
assert pathlib.Path(sarsplat.__file__).is_relative_to(sys.prefix), sarsplat.__file__
for info in pkgutil.walk_packages(sarsplat.__path__, "sarsplat."):
    if not info.name.endswith("._engine"):
        importlib.import_module(info.name)
nvrtc.sources()
"""


def main() -> int:
    """Look into every wheel, then install one."""
    wheels = sorted((ROOT / "dist").glob("*.whl"))
    for wheel in wheels:
        look_into(wheel)
        print(f"{wheel.name}: {wheel.stat().st_size / 1024:.0f} KiB, holds what it should")
    here = set(sys_tags())
    ours = [wheel for wheel in wheels if parse_wheel_filename(wheel.name)[3] & here]
    if len(ours) != 1:
        print(f"dist/ has {len(ours)} wheels for this machine instead of one: make wheels", file=sys.stderr)
        return 1
    install_and_try(ours[0])
    print(f"{ours[0].name}: works in an empty environment")
    return 0


def look_into(wheel: Path) -> None:
    """Every file that belongs in, no other, and an engine for the platform that the name promises."""
    platform = wheel.stem.split("-")[-1]
    library, begins, (offset, processor) = MAGIC[platform]
    with zipfile.ZipFile(wheel) as archive:
        found = set(archive.namelist())
        engine = archive.read(f"sarsplat/renderer/{library}")
    files = [path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    compiled = {path for path in files if path.stem == "_engine" or path.parent == SOURCES}
    belongs = ({*files} - compiled) | included(SOURCES / "kernels.cu")
    expected = {path.relative_to(PACKAGE.parent).as_posix() for path in belongs}
    metadata = {name for name in found if ".dist-info/" in name}
    assert found - metadata == expected | {f"sarsplat/renderer/{library}"}, found - metadata ^ expected
    assert {name.partition("/")[2] for name in metadata} == {
        *("METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE")
    }
    assert engine.startswith(begins), wheel
    assert engine[offset:].startswith(processor), wheel
    assert {b"sg_engine_for", b"sg_use_torch"} <= set(re.findall(rb"sg_\w+", engine)), wheel
    for path in (str(ROOT), tempfile.gettempdir(), str(Path.home())):
        assert path.encode() + os.sep.encode() not in engine, f"{wheel} names {path}"


def included(source: Path) -> set[Path]:
    """A source, and everything that it includes: what CUDA compiles on the user's machine."""
    text = re.sub(r"^#ifdef SG_KERNELS$.*?^#endif$", "", source.read_text(encoding="utf-8"), flags=re.M | re.DOTALL)
    names = re.findall(r'^#include "(.*)"', text, re.MULTILINE)
    return {source}.union(*(included(source.with_name(name)) for name in names))


def install_and_try(wheel: Path) -> None:
    """The example, every import and `sarsplat doctor`, in an environment that has nothing else."""
    example = re.search(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL | re.M)
    assert example
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        bin_ = Path(folder) / ("Scripts" if os.name == "nt" else "bin")
        python = str(bin_ / "python")
        constraints = ROOT / "constraints.txt"
        run(folder, python, "-m", "pip", "install", "--quiet", "-c", str(constraints), str(wheel))
        run(folder, python, "-W", "error", "-c", IMPORT_EVERYTHING)
        printed = run(folder, python, "-W", "error", "-c", example[1])
        reference = example[1].replace("[view], grid)", '[view], grid, engine="reference")')
        assert reference != example[1]
        pairs = zip(numbers(printed), numbers(run(folder, python, "-W", "error", "-c", reference)), strict=True)
        assert all(abs(a - b) <= 2e-3 for a, b in pairs), printed
        doctor = run(folder, str(bin_ / "sarsplat"), "doctor")
        assert "loaded, instruction set" in doctor, doctor
        print(printed, doctor, sep="\n")


def numbers(printed: str) -> list[float]:
    """What the example prints, to three or four digits after the point."""
    found = [float(number) for number in re.findall(r"-?\d+\.\d+(?:e[-+]\d+)?", printed)]
    assert len(found) == 17, printed
    return found


def run(folder: str, *command: str) -> str:
    """Standard output of a command that must succeed, away from the source tree."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        command, cwd=folder, env=environment | {"PYTHONUTF8": "1"}, capture_output=True, text=True, encoding="utf-8"
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
