"""Tests of what changed since the last commit, a file on each line: `make check` runs them.

Of a file of the library, those in its room that name it or test it by its name; of the kernels, the CPU engine's.
"""

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def changed() -> list[str]:
    """Paths that differ from the last commit, and new ones."""
    asked = (["diff", "--name-only", "HEAD"], ["ls-files", "--others", "--exclude-standard"])
    found = (subprocess.check_output(["git", *words], cwd=ROOT, text=True).splitlines() for words in asked)
    return sorted({path for paths in found for path in paths})


def tests_of(path: str) -> list[str]:
    """The tests of one file, relative to the root."""
    file = Path(path)
    if file.parts[0] == "tests":
        return [path] if file.name.startswith("test_") and (ROOT / file).exists() else []
    if "csrc" in file.parts:
        return ["tests/renderer/test_cpu_engine.py"]
    if file.parts[:2] != ("src", "sarsplat") or file.suffix != ".py":
        return []
    room = ROOT / "tests" / Path(*file.parts[2:-1])
    module = ".".join(file.with_suffix("").parts[1:])
    tests = sorted(room.rglob("test_*.py")) if len(file.parts) > 3 else sorted(room.glob("test_*.py"))
    mine = [one for one in tests if one.stem == f"test_{file.stem}" or module in one.read_text(encoding="utf-8")]
    return [str(one.relative_to(ROOT)) for one in mine]


if __name__ == "__main__":
    print(*sorted({test for path in changed() for test in tests_of(path)}), sep="\n")
