"""Methods as such: one found by an entry point, what a run keeps of its images, and the order of views."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import sarsplat
from sarsplat import Config, Dataset, Run, SarsplatError, evaluate_run, reconstruct
from sarsplat.learning.training_images import ViewQueue


def test_names_need_no_torch():
    code = "import sys; from sarsplat.runs import METHODS; print(*METHODS, 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["sar-gs", "dsr", "sar-nerf", "sar-nerf-grid", "False"]


def test_a_run_in_a_folder_of_images_in_memory_is_evaluated(dataset: Dataset, config: Config, tmp_path: Path):
    in_memory = replace(dataset, path=None)
    run = reconstruct(in_memory, replace(config, iterations=2), tmp_path / "run", quiet=True)
    assert evaluate_run(run, quiet=True)["images"]
    alone = Run.load(tmp_path / "run")
    with pytest.raises(SarsplatError, match=r"made from images in memory; give them with Run\.load"):
        _ = alone.dataset
    assert Run.load(tmp_path / "run", dataset=in_memory).dataset is in_memory
    other = replace(in_memory, power=2 * in_memory.power)
    with pytest.raises(SarsplatError, match="was made from another dataset than"):
        Run.load(tmp_path / "run", dataset=other)


def test_views_are_drawn_on_the_cpu_whatever_torchs_default_device():
    queue = ViewQueue(5, 2, torch.Generator().manual_seed(0))
    with torch.device("meta"):
        drawn = [*queue.next(), *queue.next(), *queue.next()]
    assert sorted(drawn[:5]) == [0, 1, 2, 3, 4]
    assert len(queue.waiting) == 4


def test_a_queue_resumes_where_it_stopped(finished: Run):
    queue = ViewQueue(12, 8, torch.Generator())
    queue.restore(finished.snapshot)
    assert queue.waiting == list(finished.snapshot.queue)
    for damaged in ({"queue": (12,)}, {"views": finished.snapshot.views[:3]}):
        with pytest.raises(ValueError, match="views"):
            queue.restore(replace(finished.snapshot, **damaged))


def test_a_method_of_another_package_is_one_of_the_methods(tmp_path: Path):
    """The whole page of docs/how-to/another-method.md is such a method; here, that it is found and reached."""
    (tmp_path / "flat.py").write_text("from sarsplat.learning.method_sar_gs import SarGs\nMETHOD = SarGs()\n")
    info = tmp_path / "flat-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: flat\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[sarsplat.methods]\nflat = flat:METHOD\n")
    code = "from sarsplat.cli import main; main(['reconstruct', '--help'])"
    path = {"PYTHONPATH": f"{tmp_path}:{Path(sarsplat.__file__).parent.parent}"}
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, **path}, capture_output=True, text=True)
    assert "sar-nerf-grid,flat}" in "".join(done.stdout.split()), done.stderr
