"""Gaussians of other programs: `.splat`, compressed PLY, line ends, vertical axes, and rows that are not numbers."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sarsplat.data import read_gaussians_ply
from sarsplat.data.ply import read_centred_gaussians
from sarsplat.data.upright import turned
from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.gaussians import MAX_OPTICAL_DEPTH, MIN_SCALE, Gaussians
from sarsplat.gaussians.covariance import covariance
from sarsplat.gaussians.harmonics import CONSTANTS, harmonic_basis

COUNT = 300
RANDOM = np.random.default_rng(0)


def columns(degree: int = 1) -> dict[str, np.ndarray]:
    """A scene as 3DGS programs write it."""
    generator = np.random.default_rng(0)
    names = [*"xyz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1)))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    return {name: generator.normal(size=COUNT) - 2 * name.startswith("scale") for name in names}


def write(path: Path, table: dict[str, np.ndarray], *, ends: str = "\n", comments: tuple[str, ...] = ()) -> Path:
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    head += [f"element vertex {len(table['x'])}", *(f"property float {name}" for name in table), "end_header", ""]
    path.write_bytes(ends.join(head).encode() + np.column_stack([*table.values()]).astype("<f4").tobytes())
    return path


def covariances(gaussians: Gaussians) -> torch.Tensor:
    return covariance(gaussians.quaternions, gaussians.scales)


def equal(one: Gaussians, other: Gaussians) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one.tensors().values(), other.tensors().values(), strict=True))


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
    with pytest.raises(SarsplatError, match="so that none is left"):
        read_gaussians_ply(write(tmp_path / "c.ply", nothing))


def test_infinite_logits_and_lengths_of_zero_are_meant(tmp_path):
    table = columns()
    table["opacity"][:2], table["scale_0"][2] = [np.inf, -np.inf], -np.inf
    read = read_gaussians_ply(write(tmp_path / "a.ply", table))
    assert read.optical_depth[0] == MAX_OPTICAL_DEPTH and read.optical_depth[1] < 1e-15
    assert read.scales[2, 0] == pytest.approx(MIN_SCALE)
    assert len(read) == COUNT


def test_nan_in_what_is_not_needed_does_not_matter(tmp_path):
    table = columns() | {"nx": np.full(COUNT, np.nan)}
    assert len(read_gaussians_ply(write(tmp_path / "a.ply", table))) == COUNT


@pytest.mark.parametrize(
    ("comments", "up"),
    [
        (("Exported from Brush", "Vertical axis: y"), (0, -1, 0)),
        (("Vertical Axis: Y",), (0, 1, 0)),
        (("vertical axis: x",), (1, 0, 0)),
        (("Vertical axis: -z",), (0, 0, -1)),
        (("Vertical axis: z",), (0, 0, 1)),
        (("Exported from Brush",), (0, 0, 1)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*were turned")
def test_a_stated_vertical_axis_becomes_z(tmp_path, comments, up):
    plain = read_gaussians_ply(write(tmp_path / "a.ply", columns(3)))
    read = read_gaussians_ply(write(tmp_path / "b.ply", columns(3), comments=comments))
    up = torch.tensor(up, dtype=torch.float32)
    torch.testing.assert_close(read.means[:, 2], plain.means @ up)
    matrix = torch.linalg.lstsq(plain.means, read.means).solution.T  # of the turn, and nothing else
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(matrix)) == pytest.approx(1, abs=1e-5)
    towards = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    torch.testing.assert_close(read.gamma0(towards @ matrix.T), plain.gamma0(towards), atol=1e-4, rtol=1e-4)
    np.testing.assert_allclose(covariances(read), matrix @ covariances(plain) @ matrix.T, atol=1e-4, rtol=1e-3)


def test_a_stated_vertical_axis_is_said(tmp_path):
    path = write(tmp_path / "a.ply", columns(), comments=("Exported from Brush", "Vertical axis: y"))
    with pytest.warns(SarsplatWarning, match=r"a\.ply states 'Vertical axis: y': .* turned so that −y is up"):
        read_gaussians_ply(path)


def test_turned_harmonics_are_those_of_the_turned_function():
    matrix = Rotation.from_euler("xyz", (0.3, -1.2, 2.0)).as_matrix()
    values = RANDOM.normal(size=(5, 16))
    u = RANDOM.normal(size=(9, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    before = harmonic_basis(torch.from_numpy(u), 3).numpy() @ values.T
    after = harmonic_basis(torch.from_numpy(u @ matrix.T), 3).numpy() @ turned(values, matrix).T
    np.testing.assert_allclose(after, before, atol=1e-12)


# ---- .splat ----------------------------------------------------------------------------------------------------------
def splat(path: Path, table: dict[str, np.ndarray]) -> Path:
    """What a converter makes of a PLY, written down plainly."""
    import struct

    rows = []
    for k in range(len(table["x"])):
        colour = [0.5 + table[f"f_dc_{c}"][k] * CONSTANTS[0] for c in range(3)] + [
            1 / (1 + np.exp(-table["opacity"][k]))
        ]
        turn = np.array([table[f"rot_{c}"][k] for c in range(4)])
        turn /= np.linalg.norm(turn)
        rows.append(
            struct.pack("<6f", *(table[c][k] for c in "xyz"), *(np.exp(table[f"scale_{c}"][k]) for c in range(3)))
        )
        rows.append(bytes(int(np.clip(round(255 * value), 0, 255)) for value in colour))
        rows.append(bytes(int(np.clip(round(128 + 128 * value), 0, 255)) for value in turn))
    path.write_bytes(b"".join(rows))
    return path


def test_splat_files_are_read_as_the_ply_they_were_made_from(tmp_path):
    table = columns(0)
    for k in range(3):
        table[f"f_dc_{k}"] = table[f"f_dc_{k}"] * 0.4  # colours within 0 to 1
    read, plain = (
        read_gaussians_ply(splat(tmp_path / "a.splat", table)),
        read_gaussians_ply(write(tmp_path / "a.ply", table)),
    )
    torch.testing.assert_close(read.means, plain.means)
    torch.testing.assert_close(read.scales, plain.scales)
    torch.testing.assert_close(
        1 - torch.exp(-read.optical_depth), 1 - torch.exp(-plain.optical_depth), atol=0.003, rtol=0
    )
    torch.testing.assert_close(read.scattering.parameters, plain.scattering.parameters, atol=0.01, rtol=0)
    cosines = torch.nn.functional.cosine_similarity(read.quaternions, plain.quaternions, dim=1)
    assert cosines.min() > 0.999


@pytest.mark.parametrize("size", [0, 31, 33])
def test_what_is_no_splat_file_is_refused(tmp_path, size):
    (tmp_path / "a.splat").write_bytes(bytes(size))
    with pytest.raises(SarsplatError, match=rf"a\.splat has {size} bytes, which are no whole number of Gaussians"):
        read_gaussians_ply(tmp_path / "a.splat")


@pytest.mark.parametrize("ending", [".spz", ".ksplat", ".sog", ".SPZ"])
@pytest.mark.parametrize("read", [read_gaussians_ply, read_centred_gaussians])
def test_other_formats_are_named_with_the_way_out(tmp_path, ending, read):
    (tmp_path / f"a{ending}").write_bytes(b"\x1f\x8b")
    with pytest.raises(SarsplatError, match=r"which is not read; open it in SuperSplat .* export it as PLY"):
        read(tmp_path / f"a{ending}")


# ---- compressed PLY --------------------------------------------------------------------------------------------------
def compressed(path: Path, table: dict[str, np.ndarray], *, degree: int = 0, colours: bool = True) -> Path:
    """SuperSplat's layout, packed here number by number."""
    count = len(table["x"])
    rgb = {c: 0.5 + table[f"f_dc_{k}"] * CONSTANTS[0] for k, c in enumerate("rgb")}
    ranged: dict[str, Any] = {
        **{c: table[c] for c in "xyz"},
        **{f"scale_{c}": table[f"scale_{k}"] for k, c in enumerate("xyz")},
    }
    ranged |= rgb if colours else {}
    chunks, words = [], []
    for first in range(0, count, 256):
        part = slice(first, first + 256)
        low, high = ({name: float(end(values[part])) for name, values in ranged.items()} for end in (np.min, np.max))
        for group in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb" if colours else ""):
            chunks += [low[name] for name in group] + [high[name] for name in group]

        def packed(name: str, k: int, bits: int, low: dict = low, high: dict = high) -> int:
            value = ranged[name][k] if name in ranged else rgb[name][k]
            a, b = (low[name], high[name]) if name in ranged else (0.0, 1.0)
            return round(float(np.clip((value - a) / (b - a), 0, 1)) * ((1 << bits) - 1))

        for k in range(first, min(first + 256, count)):
            position = packed("x", k, 11) << 21 | packed("y", k, 10) << 11 | packed("z", k, 11)
            scale = packed("scale_x", k, 11) << 21 | packed("scale_y", k, 10) << 11 | packed("scale_z", k, 11)
            alpha = round(255 / (1 + np.exp(-table["opacity"][k])))
            colour = packed("r", k, 8) << 24 | packed("g", k, 8) << 16 | packed("b", k, 8) << 8 | alpha
            turn = np.array([table[f"rot_{c}"][k] for c in range(4)])
            turn /= np.linalg.norm(turn)
            largest = int(np.abs(turn).argmax())
            turn *= np.sign(turn[largest])
            rotation = largest
            for c in range(4):
                if c != largest:
                    rotation = rotation << 10 | round((turn[c] * 0.5**0.5 + 0.5) * 1023)
            words.append((position, rotation, scale, colour))
    axes = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    axes += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if colours else []
    rest = [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]
    head = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-count // 256)}"]
    head += [f"property float {name}" for name in axes] + [f"element vertex {count}"]
    head += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    head += [f"element sh {count}", *(f"property uchar {name}" for name in rest)] if rest else []
    data = np.array(chunks, "<f4").tobytes() + np.array(words, "<u4").tobytes()
    if rest:
        data += (
            np.column_stack([np.clip(np.round((table[name] + 4) * 255 / 8), 0, 255) for name in rest])
            .astype("u1")
            .tobytes()
        )
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + data)
    return path


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("colours", [False, True])
def test_compressed_ply_is_read_as_what_it_was_made_from(tmp_path, degree, colours):
    table = columns(degree)
    for k in range(3):
        table[f"f_dc_{k}"] = table[f"f_dc_{k}"] * 0.4
    read = read_gaussians_ply(compressed(tmp_path / "a.compressed.ply", table, degree=degree, colours=colours))
    plain = read_gaussians_ply(write(tmp_path / "a.ply", table))
    torch.testing.assert_close(read.means, plain.means, atol=0.005, rtol=0)
    torch.testing.assert_close(read.scales.log(), plain.scales.log(), atol=0.005, rtol=0)
    torch.testing.assert_close(
        1 - torch.exp(-read.optical_depth), 1 - torch.exp(-plain.optical_depth), atol=0.003, rtol=0
    )
    torch.testing.assert_close(read.scattering.parameters, plain.scattering.parameters, atol=0.03, rtol=0)
    cosines = torch.nn.functional.cosine_similarity(read.quaternions, plain.quaternions, dim=1).abs()
    assert cosines.min() > 0.9999


def test_a_compressed_ply_that_lacks_something_is_named(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 4\n"
    head += "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    (tmp_path / "a.ply").write_bytes(f"{head}end_header\n".encode() + bytes(4 + 64))
    with pytest.raises(
        SarsplatError, match="a compressed PLY without some of its properties; export it again, uncompr"
    ):
        read_gaussians_ply(tmp_path / "a.ply")
