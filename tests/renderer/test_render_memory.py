"""Running out of memory is told in a sentence, and the engine works afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="limits the address space as Linux does"),
    pytest.mark.skipif("SARSPLAT_TEST_ENGINE" in os.environ, reason="sanitizers need the address space"),
]

PROGRAM = """
import resource, sys
sys.path.insert(0, sys.argv[1])
import torch
from named_scenes import GRID, VIEWS, cloud
from sarsplat import SarsplatError
from sarsplat.geometry import ImageGrid, RayGrid
from sarsplat.renderer import render

torch.set_num_threads(1)
small = cloud(10, 0)
before = render(small, VIEWS, GRID).images

def leave(megabytes):
    size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (megabytes << 20), resource.RLIM_INFINITY))

def refused(call):
    try:
        call()
    except SarsplatError as error:
        return str(error)

def everything(count):
    scene = cloud(count, 1, degree=0)
    scene.means.requires_grad_()
    return render(scene, VIEWS, GRID, first_return_depth=1.0, rays=rays).images

which, rays = sys.argv[2], RayGrid((0.1, 0.1))
if which == "forward":
    leave(100)
    print(refused(lambda: everything(300_000)))
elif which == "rays":
    rays = RayGrid((0.0005, 0.0005))
    leave(100)
    print(refused(lambda: everything(3)))
else:
    images = everything(240_000)  # whose backward pass outgrows what the forward pass left over
    leave(30)  # for the gradients themselves
    print(refused(lambda: images.sum().backward(retain_graph=True)))
    leave(500)
    images.sum().backward()
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
print(torch.equal(render(small, VIEWS, GRID).images, before))
"""


@pytest.mark.parametrize("which", ["forward", "rays", "backward"])
def test_out_of_memory(which):
    arguments = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), which]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    sentence, same = done.stdout.splitlines()
    assert sentence.startswith("there is not enough memory for the rendering; render fewer views")
    assert same == "True"
