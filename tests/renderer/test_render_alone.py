"""What could end or starve the process that tries it, in a program of its own, which forks for most of it.

Running out of memory is told in a sentence, and the engine works afterwards; so it does in a forked process.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import json, os, sys
sys.path.insert(0, sys.argv[1])
import torch
from named_scenes import GRID, VIEWS, cloud
from sarsplat import SarsplatError
from sarsplat.gaussians import Gaussians, Harmonics
from sarsplat.geometry import RayGrid
from sarsplat.renderer import render

def refused(call):
    try:
        call()
    except SarsplatError as error:
        return str(error)

def rows_went_away():
    parameters = [torch.nn.Parameter(tensor) for tensor in cloud(3000, 1).tensors().values()]
    images = render(Gaussians(*parameters[:4], Harmonics(parameters[4])), VIEWS, GRID, engine="cpu").images
    for parameter in parameters:
        parameter.data = parameter.data[:10].clone()
    said = refused(lambda: images.sum().backward())
    del images
    [torch.full((k,), 1.0) for k in range(3000)]
    return said

def leave(megabytes):
    size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (megabytes << 20), resource.RLIM_INFINITY))

def everything(count, spacing=0.1):
    scene = cloud(count, 1, degree=0)
    scene.means.requires_grad_()
    rays = RayGrid((spacing, spacing))
    return render(scene, VIEWS, GRID, first_return_depth=1.0, rays=rays).images

def starved(which):
    if which == "forward":
        leave(100)
        return refused(lambda: everything(300_000))
    if which == "rays":
        leave(100)
        return refused(lambda: everything(3, 0.0005))
    images = everything(240_000)  # whose backward pass outgrows what the forward pass left over
    leave(30)  # for the gradients themselves
    said = refused(lambda: images.sum().backward(retain_graph=True))
    leave(500)
    images.sum().backward()
    return said

def child(which):
    torch.set_num_threads(1)
    said = None
    if which != "forked":
        said = starved(which)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    print(json.dumps([which, said, torch.equal(render(small, VIEWS, GRID).images, before)]), flush=True)

torch.set_num_threads(1)  # threads have memory of their own, which would be left over
small = cloud(60, 1)
before = render(small, VIEWS, GRID, engine="cpu").images
for which in sys.argv[2:]:
    if which == "forked":
        torch.set_num_threads(2)
        render(small, VIEWS, GRID, engine="cpu")
    else:
        import resource
    if not (process := os.fork()):
        child(which)
        os._exit(0)
    os.waitpid(process, 0)
print(json.dumps(["rows went away", rows_went_away(), True]), flush=True)
"""
LIMITED = ["forward", "rays", "backward"]
"""Address space as Linux limits it; sanitizers need all of it."""


@pytest.fixture(scope="module")
def done() -> dict[str, tuple[str | None, bool]]:
    """What was said in each case, and whether the engine rendered the same afterwards."""
    cases = LIMITED if sys.platform == "linux" and "SARSPLAT_TEST_ENGINE" not in os.environ else []
    cases = [*cases, *["forked"] * hasattr(os, "fork")]
    arguments = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), *cases]
    program = subprocess.run(arguments, capture_output=True, text=True, timeout=100)
    assert program.returncode == 0, program.stderr
    found = {which: tuple(rest) for which, *rest in map(json.loads, program.stdout.splitlines())}
    return dict.fromkeys(cases, (program.stderr, False)) | found


def test_parameters_whose_rows_went_away_between_the_passes(done):
    said, _ = done["rows went away"]
    assert said.startswith("means had shape (3000, 3) when rendered and now has shape (10, 3)")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_renders_too(done):
    """On one thread, as torch's data loaders set it: OpenMP's threads do not survive a fork, with or without us."""
    assert done["forked"] == (None, True)


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space as Linux does")
@pytest.mark.skipif("SARSPLAT_TEST_ENGINE" in os.environ, reason="sanitizers need the address space")
@pytest.mark.parametrize("which", LIMITED)
def test_out_of_memory(which, done):
    sentence, same = done[which]
    assert sentence.startswith("there is not enough memory for the rendering; render fewer views")
    assert same
