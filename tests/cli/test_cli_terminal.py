"""What reaches the terminal: on any encoding, without control characters, and in one sentence when memory runs out."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

RUN = "import sys, sarsplat.cli; sys.exit(sarsplat.cli.main())"
SIMULATE = ["simulate", "--target", "t72", "--azimuth", "0", "180", "--grazing", "45", "--pixels", "16"]


def test_terminals_that_know_few_letters(tmp_path: Path) -> None:
    both = "import sys; from sarsplat.cli import main; sys.exit(main(sys.argv[2:]) or main(['info', sys.argv[1]]))"
    out = str(tmp_path / "out")
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    command = [sys.executable, "-c", both, out, *SIMULATE, "--out", out]
    shown = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert shown.returncode == 0, shown.stderr
    assert b"mean ?" in shown.stdout
    assert b"Traceback" not in shown.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals are tested on Linux")
def test_mistakes_are_one_sentence_on_a_terminal_too(tmp_path: Path) -> None:
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", RUN, "simulate", "128", "--out", str(tmp_path / "out")]
    environment = os.environ | {"TERM": "xterm-256color"}
    done = subprocess.run(command, stdout=theirs, stderr=theirs, env=environment, check=False)
    shown = os.read(ours, 10_000).decode()
    assert done.returncode == 2
    assert "'128' is one argument too many for sarsplat simulate; remove it" in shown
    assert "\\x1b" not in shown


def test_escape_sequences_of_strangers_are_not_sent(tmp_path: Path, said) -> None:
    said([*SIMULATE, "--out", str(tmp_path / "out")])
    header = tmp_path / "out" / "dataset.json"
    data = json.loads(header.read_text())
    data["source"]["target"] = "\x1b]0;gone\x07[red]t72"
    header.write_text(json.dumps(data))
    shown = said(f"info {tmp_path}/out")
    assert "\x1b" not in shown
    assert "\x07" not in shown
    assert r"\x1b]0;gone\x07[red]t72" in shown


def test_when_memory_runs_out(tmp_path: Path) -> None:
    limit = (
        "import resource, torch, sarsplat.cli\n"
        "size = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (size + (900 << 20), resource.RLIM_INFINITY))\n"
    )
    command = [sys.executable, "-c", limit + RUN, *SIMULATE[:-1], "20000", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "memory" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
