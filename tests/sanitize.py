"""The engine under AddressSanitizer and UndefinedBehaviorSanitizer, over the renderer's tests: `make sanitize`.

Needs Debian's clang with its runtime, clang-16 or newer: apt-get install clang-19 libclang-rt-19-dev. (The `ziglang`
wheel, which builds the engine otherwise, has no AddressSanitizer runtime.) Arguments are passed on to pytest.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src" / "sarsplat" / "renderer" / "csrc"
FLAGS = [
    *("-std=c++17", "-O1", "-g", "-fPIC", "-fno-exceptions", "-fno-rtti", "-fno-omit-frame-pointer"),
    *("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-shared-libsan"),
    *("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"),
]
LEVELS = {"base": (4, []), "avx2": (8, ["-march=x86-64-v3"]), "avx512": (16, ["-march=x86-64-v4"])}
# What exercises the engine; the memory growth test would measure the sanitizer instead. A report goes to file
# descriptor 2 and ends the process, so pytest must not capture that.
TESTS = [
    "tests/renderer",
    "tests/learning/test_losses.py",
    "tests/learning/test_optimiser.py",
    "-k",
    "not memory_does_not_grow",
    "--capture=sys",
]


def main() -> int:
    """Build, then run the tests on what was built; the exit code is theirs."""
    compiler = next((path for version in range(30, 15, -1) if (path := shutil.which(f"clang++-{version}"))), None)
    if compiler is None or platform.machine() != "x86_64":
        print("make sanitize needs clang++-16 or newer on x86-64: apt-get install clang-19 libclang-rt-19-dev")
        return 2
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        jobs = [(isa, "engine.cpp", [*more, f"-DSG_ISA={isa}", f"-DSG_WIDTH={n}"]) for isa, (n, more) in LEVELS.items()]
        sets = "".join(f"SET({i}, {isa}) " for i, isa in enumerate(LEVELS, 1))
        digest = hashlib.sha256((SOURCES / "api.h").read_bytes()).hexdigest()
        jobs += [
            ("dispatch", "dispatch.cpp", [f"-DSG_SETS={sets}", f"-DSG_API={digest}"]),
            ("parallel", "parallel.cpp", []),
        ]
        for name, source, more in jobs:
            print(f"compiling {name} under the sanitizers", flush=True)
            objects.append(f"{folder}/{name}.o")
            subprocess.check_call([compiler, *FLAGS, *more, "-c", str(SOURCES / source), "-o", objects[-1]])
        library = f"{folder}/engine.so"
        subprocess.check_call([compiler, *FLAGS, "-shared", *objects, "-o", library])
        runtime = subprocess.check_output([compiler, "-print-file-name=libclang_rt.asan-x86_64.so"], text=True).strip()
        environment = os.environ | {
            "SARSPLAT_TEST_ENGINE": library,
            "LD_PRELOAD": runtime,
            # Python itself keeps memory to the end; what the engine leaks shows in the tests of memory growth
            "ASAN_OPTIONS": "detect_leaks=0:strict_string_checks=1:detect_stack_use_after_return=1",
            "UBSAN_OPTIONS": "print_stacktrace=1",
        }
        return subprocess.call([sys.executable, "-m", "pytest", *TESTS, *sys.argv[1:]], cwd=ROOT, env=environment)


if __name__ == "__main__":
    raise SystemExit(main())
