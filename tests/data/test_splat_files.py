"""Gaussians of other programs: `.splat`, line ends, and rows that are not numbers."""

import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

from made import pack_glb
from sarsplat.data import read_gaussians_ply, write_gaussians_ply
from sarsplat.data.gltf_splats import glb_bytes
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians
from sarsplat.gaussians.gaussians import covariance
from sarsplat.gaussians.law_harmonics import CONSTANTS

COUNT = 300


def columns(degree: int = 1) -> dict[str, np.ndarray]:
    """A scene as 3DGS programs write it."""
    generator = np.random.default_rng(0)
    names = [*"xyz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1)))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    return {name: generator.normal(size=COUNT) - 2 * name.startswith("scale") for name in names}


def write(path: Path, table: dict[str, np.ndarray], *, ends: str = "\n") -> Path:
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"element vertex {len(table['x'])}", *(f"property float {name}" for name in table), "end_header", ""]
    path.write_bytes(ends.join(head).encode() + np.column_stack([*table.values()]).astype("<f4").tobytes())
    return path


def equal(one: Gaussians, other: Gaussians) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one.tensors().values(), other.tensors().values(), strict=True))


def test_colours_and_opacities_become_scattering_and_depth(tmp_path):
    table = {name: np.zeros(2) for name in columns()} | {"rot_0": np.ones(2), "f_dc_0": 3 * np.ones(2)}
    table |= {"f_dc_1": 6 * np.ones(2), "opacity": np.array([0, 100]), "scale_0": np.array([-20, np.log(0.5)])}
    table |= {f"f_rest_{3 * channel + 1}": np.full(2, channel + 1.0) for channel in range(3)}  # the z harmonic
    read = read_gaussians_ply(write(tmp_path / "a.ply", table))
    assert read.scattering.p_min == 0
    torch.testing.assert_close(read.optical_depth, torch.tensor([np.log(2), MAX_OPTICAL_DEPTH], dtype=torch.float32))
    torch.testing.assert_close(read.scales[:, 0], torch.tensor([MIN_SCALE, 0.5]))
    torch.testing.assert_close(read.scattering.parameters[0], torch.tensor([3.0, 0, -2, 0]))


def test_filters_of_mip_splatting_are_folded_in_and_flat_gaussians_named(tmp_path):
    table = columns() | {"filter_3D": np.full(COUNT, 0.3)}
    read, plain = (read_gaussians_ply(write(tmp_path / "a.ply", one)) for one in (table, columns()))
    torch.testing.assert_close(read.scales, torch.sqrt(plain.scales**2 + 0.09))
    opacity = (1 - torch.exp(-plain.optical_depth)) * (plain.scales / read.scales).prod(1)
    torch.testing.assert_close(1 - torch.exp(-read.optical_depth), opacity)
    with pytest.raises(SarsplatError, match=r"flat Gaussians \(2DGS\), which have no scale_2; add it"):
        read_gaussians_ply(write(tmp_path / "a.ply", {name: one for name, one in table.items() if name != "scale_2"}))


def in_glb(path: Path, gaussians: Gaussians, **node: list[float]) -> dict:
    """Write a file whose node has this transformation, and return its scene."""
    data = glb_bytes(gaussians, "db")
    length = int.from_bytes(data[12:16], "little")
    scene = json.loads(data[20 : 20 + length])
    scene["nodes"][0] |= node
    path.write_bytes(pack_glb(json.dumps(scene).encode(), data[20 + length :]))
    return scene


def test_gaussians_in_gltf_are_those_of_the_ply(tmp_path):
    """Valid for another reader, y up, with the same colours from every direction, also where a node moves them."""
    trimesh = pytest.importorskip("trimesh")
    gaussians = read_gaussians_ply(write(tmp_path / "a.ply", columns(3)))
    write_gaussians_ply(tmp_path / "ours.ply", gaussians)
    plain = (tmp_path / "ours.ply").read_bytes().replace(b"comment sarsplat gaussians 2\n", b"")
    (tmp_path / "shades.ply").write_bytes(plain)  # as viewers read it
    shades = read_gaussians_ply(tmp_path / "shades.ply")
    scene = in_glb(tmp_path / "a.glb", gaussians)
    assert scene["meshes"][0]["extras"]["harmonics"].startswith("colours: gamma0 in dB, black = ")
    (cloud,) = trimesh.load_scene(tmp_path / "a.glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, gaussians.means.numpy()[:, [0, 2, 1]] * (1, 1, -1), rtol=1e-6)
    read = read_gaussians_ply(tmp_path / "a.glb")
    half = np.sqrt(0.5)
    in_glb(tmp_path / "b.glb", gaussians, translation=[0, 3, 0], scale=[2, 2, 2], rotation=[0, half, 0, half])
    moved = read_gaussians_ply(tmp_path / "b.glb")  # 90° about the vertical axis, which is y in the file
    turned = shades.means[:, [1, 0, 2]] * torch.tensor([-1.0, 1, 1])
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    for one, means, seen in ((read, shades.means, directions), (moved, 2 * turned + torch.tensor([0, 0, 3.0]), None)):
        torch.testing.assert_close(one.means, means, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(one.optical_depth, shades.optical_depth, rtol=1e-3, atol=1e-4)
        from_there = directions if seen is not None else directions[:, [1, 0, 2]] * torch.tensor([1.0, -1, 1])
        torch.testing.assert_close(one.gamma0(directions), shades.gamma0(from_there), rtol=1e-3, atol=1e-4)
    shapes = [covariance(one.quaternions, one.scales) for one in (read, shades)]
    torch.testing.assert_close(*shapes, rtol=1e-4, atol=1e-6)
    for node in ({"scale": [1, 2, 1]}, {"scale": [-1, 1, 1]}, {"rotation": [0, 0, 0, 0]}):
        in_glb(tmp_path / "c.glb", gaussians, **node)
        with pytest.raises(SarsplatError, match=r"cannot be read as Gaussians in glTF \(.*; write it as a PLY of 3DGS"):
            read_gaussians_ply(tmp_path / "c.glb")
    linear = (tmp_path / "a.glb").read_bytes().replace(b'"srgb_rec709_display"', b'"lin_rec709_display" ')
    (tmp_path / "c.glb").write_bytes(linear)
    with pytest.raises(SarsplatError, match="kernel ellipse, colorSpace lin_rec709_display"):
        read_gaussians_ply(tmp_path / "c.glb")


@pytest.mark.parametrize("ends", ["\r\n", "\r"])
def test_headers_may_have_other_line_ends(tmp_path, ends):
    plain = read_gaussians_ply(write(tmp_path / "a.ply", columns()))
    assert equal(read_gaussians_ply(write(tmp_path / "b.ply", columns(), ends=ends)), plain)


def test_rows_that_are_no_numbers_are_left_out_and_counted(tmp_path):
    whole = columns()
    broken = {name: column.copy() for name, column in whole.items()}
    broken["x"][0], broken["f_dc_1"][1], broken["scale_2"][2], broken["opacity"][3] = np.nan, np.inf, 400, np.nan
    for k in range(4):
        broken[f"rot_{k}"][4] = 0
    with pytest.warns(SarsplatWarning, match=r"a\.ply: 5 Gaussians of 300 hold NaN or an infinity, or no orientation"):
        read = read_gaussians_ply(write(tmp_path / "a.ply", broken))
    rest = {name: column[5:] for name, column in whole.items()}
    assert equal(read, read_gaussians_ply(write(tmp_path / "b.ply", rest)))
    nothing = dict.fromkeys(whole, np.full(3, np.nan))
    with pytest.raises(SarsplatError, match="3 Gaussians of 3"):
        read_gaussians_ply(write(tmp_path / "c.ply", nothing))


def test_infinite_logits_and_lengths_of_zero_are_meant(tmp_path):
    table = columns() | {"nx": np.full(COUNT, np.nan)}  # which is not needed
    table["opacity"][:2], table["scale_0"][2] = [np.inf, -np.inf], -np.inf
    read = read_gaussians_ply(write(tmp_path / "a.ply", table))
    assert read.optical_depth[0] == MAX_OPTICAL_DEPTH and read.optical_depth[1] < 1e-15
    assert read.scales[2, 0] == pytest.approx(MIN_SCALE)
    assert len(read) == COUNT


# ---- .splat ----------------------------------------------------------------------------------------------------------
def splat(path: Path, table: dict[str, np.ndarray]) -> Path:
    """The file that a converter makes of a PLY."""
    lengths = np.column_stack([table[c] for c in "xyz"] + [np.exp(table[f"scale_{c}"]) for c in range(3)])
    colour = [0.5 + table[f"f_dc_{c}"] * CONSTANTS[0] for c in range(3)] + [1 / (1 + np.exp(-table["opacity"]))]
    turn = np.column_stack([table[f"rot_{c}"] for c in range(4)])
    turn = 128 + 128 * turn / np.linalg.norm(turn, axis=1, keepdims=True)
    octets = np.clip(np.round(np.column_stack([255 * np.column_stack(colour), turn])), 0, 255).astype(np.uint8)
    path.write_bytes(np.concatenate([lengths.astype("<f4").view(np.uint8), octets], axis=1).tobytes())
    return path


def test_splat_files_are_read_as_the_ply_they_were_made_from(tmp_path):
    table = columns(0)
    for k in range(3):
        table[f"f_dc_{k}"] = table[f"f_dc_{k}"] * 0.4  # colours within 0 to 1
    read = read_gaussians_ply(splat(tmp_path / "a.splat", table))
    plain = read_gaussians_ply(write(tmp_path / "a.ply", table))
    torch.testing.assert_close(read.means, plain.means)
    torch.testing.assert_close(read.scales, plain.scales)
    opacity, expected = (1 - torch.exp(-one.optical_depth) for one in (read, plain))
    torch.testing.assert_close(opacity, expected, atol=0.003, rtol=0)
    torch.testing.assert_close(read.scattering.parameters, plain.scattering.parameters, atol=0.01, rtol=0)
    cosines = torch.nn.functional.cosine_similarity(read.quaternions, plain.quaternions, dim=1)
    assert cosines.min() > 0.999


def test_a_stated_vertical_axis_other_than_z_is_refused(tmp_path):
    path = write(tmp_path / "a.ply", columns())
    plain = path.read_bytes()
    for axis in ("z", "y", "-z"):
        path.write_bytes(plain.replace(b"element", f"comment Vertical axis: {axis}\nelement".encode(), 1))
        with nullcontext() if axis == "z" else pytest.raises(SarsplatError, match="convert it to a plain PLY, z up"):
            read_gaussians_ply(path)
