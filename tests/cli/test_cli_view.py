"""`sarsplat view`: where it is, how it ends, and what it says if it cannot be."""

import os
import re
import signal
import socket
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest
import torch

from made import small_dataset, upright
from sarsplat import SarsplatError, write_gaussians_ply
from sarsplat.cli import main
from sarsplat.data import write_dataset

pytest.importorskip("viser")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "dataset", small_dataset())
    return tmp_path / "dataset"


@pytest.mark.skipif(os.name != "posix", reason="sends an interrupt")
def test_it_serves_until_ctrl_c_and_ends_with_one_sentence(folder, capsys, monkeypatch):
    before, told, pages = set(threading.enumerate()), [], []

    def look() -> None:
        while not (said := re.search(r"open (http\S+)", "".join(told))):
            told.append(capsys.readouterr().out)
            time.sleep(0.01)
        with urllib.request.urlopen(said[1]) as answer:
            pages.append(answer.read())
        os.kill(os.getpid(), signal.SIGINT)

    reader = threading.Thread(target=look)
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        reader.start()
        assert main(["view", str(folder), "--port", "0"]) == 0
    except KeyboardInterrupt:
        pytest.fail("it did not end by itself")
    finally:
        reader.join()
        signal.signal(signal.SIGINT, usual)
    (page,) = pages
    assert b"sarsplat view" in page
    out, err = capsys.readouterr()
    address = re.search(r"open (http\S+)", "".join(told))[1]
    assert out.split("\n", 1)[-1].replace("\n", "").strip() == f"ended; {address} no longer answers"
    assert err == ""
    assert not [one for one in set(threading.enumerate()) - before if not one.daemon]  # none keeps the process


def test_a_port_in_use_is_one_sentence(folder, refused):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        told = refused(f"view {folder} --port {port}")
    assert f"port {port} of this machine cannot be used (address already in use); choose another" in told


def test_gaussians_far_from_the_origin_are_moved_there_and_it_says_by_how_much(tmp_path, said, monkeypatch):
    from sarsplat.viewer import Viewer

    far = upright(torch.tensor([[4.1e6, 0.9e6, 4.8e6], [4.1e6 + 4, 0.9e6, 4.8e6 + 2]]))
    write_gaussians_ply(tmp_path / "far.ply", far)

    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupt)
    told = " ".join(said(f"view {tmp_path}/far.ply --port 0").split())
    assert "open http://127.0.0.1:" in told
    assert "the Gaussians lie around (4100002, 900000, 4800000) m; that was subtracted" in told
    with pytest.raises(SarsplatError, match=r"around \(4100002, 900000, 4800000\) m, too far .*; subtract that"):
        Viewer(far)


def test_the_extra_is_named_if_it_is_missing(folder, refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    told = "error: this needs viser, which is not installed; install it with: pip install 'sarsplat[view]'\n"
    assert refused(f"view {folder}") == told


def test_other_methods_cannot_be_watched(folder, refused):
    words = f"reconstruct {folder} --out {folder}/run --method dsr --view"
    assert "--view cannot show a training by dsr; omit it" in refused(words)
