"""Help must be instant."""

import subprocess
import sys

import pytest

PROGRAM = """
import sys, time
from sarsplat.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    heavy = sorted({"torch", "numpy", "scipy", "matplotlib", "trimesh"} & set(sys.modules))
    print(f"code={end.code} heavy={heavy} cpu={time.process_time()}")
"""


@pytest.mark.parametrize("command", [["--help"], ["simulate", "--help"], ["render", "--help"]])
def test_help_is_fast_and_imports_nothing_heavy(command: list[str]) -> None:
    shown = subprocess.run([sys.executable, "-c", PROGRAM, *command], capture_output=True, text=True, check=True).stdout
    last = shown.splitlines()[-1]
    assert "code=0 heavy=[]" in last
    assert float(last.rpartition("=")[2]) < 0.5
    assert "usage: sarsplat" in shown


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    from sarsplat.cli import main

    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sarsplat ")
