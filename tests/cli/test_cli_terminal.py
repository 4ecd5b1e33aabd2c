"""What reaches the terminal: on any encoding, without control characters, and in one sentence when memory runs out."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sarsplat.cli import main

RUN = "import sys, sarsplat.cli; sys.exit(sarsplat.cli.main())"
SIMULATE = ["simulate", "--target", "t72", "--azimuth", "0", "180", "--grazing", "45", "--pixels", "16"]


def test_terminals_that_know_few_letters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in ([*SIMULATE, "--out", f"{tmp_path}/out"], ["info", f"{tmp_path}/out"]):
        shown = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
        monkeypatch.setattr(sys, "stdout", shown)
        assert main(command) == 0
        shown.flush()
    assert b"mean ?" in shown.buffer.getvalue()


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


@pytest.mark.skipif(sys.platform != "linux", reason="the size of a process is read from /proc")
def test_when_memory_runs_out(tmp_path: Path, refused) -> None:
    import resource

    usual = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (900 << 20), usual[1]))
    try:
        told = refused([*SIMULATE[:-1], "20000", "--out", f"{tmp_path}/out"])
    finally:
        resource.setrlimit(resource.RLIMIT_AS, usual)
    assert "memory" in told
    assert not list(tmp_path.iterdir())
