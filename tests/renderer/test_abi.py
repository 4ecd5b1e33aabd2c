"""What Python reads of the engine's C declarations is what a compiler makes of them; and who uses it."""

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sarsplat.renderer.engines.abi import HEADER, SOURCES, api, filled, structures


def test_structures_lie_as_a_compiler_lays_them(tmp_path: Path) -> None:
    pytest.importorskip("ziglang", reason="compiled with ziglang")
    said = [f'#include "{HEADER}"', "#include <cstddef>"]
    for name, one in vars(api).items():
        said.append(f"static_assert(sizeof(sg_{name}) == {ctypes.sizeof(one)});")
        said += [f"static_assert(offsetof(sg_{name}, {of}) == {getattr(one, of).offset});" for of, _ in one._fields_]
        said += [f"static_assert(sizeof(((sg_{name}*)0)->{of}) == {getattr(one, of).size});" for of, _ in one._fields_]
    assert len(said) > 300
    source = tmp_path / "layouts.cpp"
    source.write_text("\n".join(said))
    command = [sys.executable, "-m", "ziglang", "c++", "-std=c++17", "-c", source, "-o", tmp_path / "layouts.o"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_structure_and_no_function_is_overlooked() -> None:
    text = HEADER.read_text()
    assert len(vars(api)) == text.count("\nstruct sg_") - text.count("\nstruct sg_context;")
    functions = dict(api.engine._fields_)
    assert [len(functions[name]._argtypes_) for name in ("create", "render", "trace", "splat_backward")] == [0, 4, 6, 7]
    assert functions["create"]._restype_ is ctypes.c_void_p
    assert functions["statistics"]._restype_ is None
    assert functions["lit_ground"]._argtypes_ == (ctypes.c_void_p, ctypes.POINTER(api.ground))


def test_declarations() -> None:
    made = structures(
        """
        struct sg_one { int32_t a, b; };  // struct sg_comment { float x; };
        struct other {
          const sg_one* typed; const float *x, *const_y;
          float* p, q[3];  // 3
          sg_one inside;
        };
        """
    )
    assert [(name, of) for name, of in made["other"]._fields_ if name not in ("q", "inside")] == [
        ("typed", ctypes.POINTER(made["sg_one"])),
        ("x", ctypes.c_void_p),
        ("const_y", ctypes.c_void_p),
        ("p", ctypes.c_void_p),
    ]
    assert made["other"].q.size == 12
    assert made["other"].inside.size == 8
    assert list(structures((SOURCES / "cuda_state.cuh").read_text(), ["Lattice"])) == ["Lattice"]


def test_a_structure_is_filled() -> None:
    lit, places = torch.empty(2, 3), [{"rows": (0.5, 2.0, 3), "columns": (1.0, 1.5, 4)}] * 2
    call = filled("lit_ground", {"views": 2, "std": (0.25, 0.5), "patches": places, "lit": lit, "shift": None})
    assert (call.views, tuple(call.std), call.lit, call.shift) == (2, (0.25, 0.5), lit.data_ptr(), None)
    assert (call.patches[1].rows.step, call.patches[1].columns.count) == (2.0, 4)
