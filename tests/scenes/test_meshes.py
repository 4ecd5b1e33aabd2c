"""Mesh files: clean, dirty, foreign."""

import json
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.geometry import ImageGrid
from sarsplat.scenes import load_mesh, paper_grid
from sarsplat.scenes.meshes import scaled, suspicious_size

trimesh = pytest.importorskip("trimesh")

REAL_MESHES = Path(__file__).resolve().parents[3] / "shared" / "data" / "meshes"

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


BOX = trimesh.creation.box((4, 2, 1))
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def check_box(path: Path) -> None:
    mesh = load_mesh(path)
    assert (len(mesh.faces), mesh.area) == (12, pytest.approx(28))
    assert mesh.bounds == pytest.approx(BOX.bounds)


@pytest.mark.parametrize("ends", [b"\n", b"\r\n", b"\r"])
def test_a_ply_header_may_have_any_line_ends(tmp_path, ends):
    header, end, body = BOX.export(file_type="ply").partition(b"end_header\n")
    (tmp_path / "box.ply").write_bytes((header + end).replace(b"\n", ends) + body)
    check_box(tmp_path / "box.ply")


def test_vertices_may_be_counted_back_from_a_face(tmp_path):
    """As programs do that write a file face by face, each after its corners; the numbers of texture count likewise."""
    lines = ["mtllib a.mtl", "vt 0 0"]
    for quad in QUADS:
        lines += ["v {} {} {}".format(*BOX.vertices[k]) for k in quad]
        lines += ["vn 0 0 1", "usemtl grey", "f -4/-1/-1 -3/-1/-1 \\", " -2/1/-1 -1/-1/-1 # a side"]
    for ends in ("\n", "\r\n", "\r"):
        (tmp_path / "box.obj").write_bytes(ends.join([*lines, ""]).encode())
        check_box(tmp_path / "box.obj")


def test_indented_lines_and_comments_that_end_in_a_backslash_are_read(tmp_path):
    lines = ["# C:\\models\\", *("\tv {} {} {}".format(*vertex) for vertex in BOX.vertices)]
    lines += [" f {} {} {} {} # a side".format(*(k + 1 for k in quad)) for quad in QUADS]
    check_box(write(tmp_path / "box.obj", "\n".join([*lines, ""])))


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1 2 0", "f 1/1 00/1 2/1", "f 0 -1 -2", "f -9 1 2"])
def test_faces_of_vertices_that_there_are_not_are_refused(tmp_path, face):
    """Trimesh takes 0 for the last vertex."""
    path = write(tmp_path / "a.obj", f"{SQUARE}vt 0 0\nf 1 2 3\n{face}\n")
    with pytest.raises(SarsplatError, match=r"a\.obj' has faces that refer to missing vertices"):
        load_mesh(path)


def test_gaussians_in_a_glb_are_named(tmp_path):
    scene = json.dumps({"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"]}).encode()
    scene += b" " * (-len(scene) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(scene), len(scene), int.from_bytes(b"JSON", "little"))
    (tmp_path / "a.glb").write_bytes(head + scene)
    with pytest.raises(SarsplatError, match=r"a\.glb' holds Gaussians"):
        load_mesh(tmp_path / "a.glb")


def glb(path: Path, *primitives: dict, **more: object) -> Path:
    """A square of four corners around each primitive, 1 m by 1 m, and then one of a hidden node."""
    corners = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]], "<f4")
    data = corners.tobytes() + np.array([0, 1, 2, 3], "<u2").tobytes()
    views = [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 8}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 0, 1]},
        {"bufferView": 1, "componentType": 5123, "count": 4, "type": "SCALAR"},
    ]
    nodes = [{"mesh": 0}, {"mesh": 0, "scale": [9, 9, 9], "extensions": {"KHR_node_visibility": {"visible": False}}}]
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6, **one} for one in primitives]}]
    scene = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1]}], "nodes": nodes, "meshes": meshes}
    scene |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}], **more}
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data)) + struct.pack("<I4s", len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(data), b"BIN\0") + data)
    return path


@pytest.mark.parametrize("indices", [{}, {"indices": 1}])
def test_fans_are_read_and_hidden_nodes_left_out(tmp_path, indices):
    with pytest.warns(SarsplatWarning, match="left out 1 node that the file hides"):
        mesh = load_mesh(glb(tmp_path / "a.glb", indices))
    assert mesh.area == pytest.approx(1)
    assert len(mesh.faces) == 2


def test_extensions_that_a_glb_needs_are_named(tmp_path):
    needed = ["KHR_materials_unlit", "EXT_mesh_gpu_instancing"]
    with pytest.raises(SarsplatError, match="needs EXT_mesh_gpu_instancing, which is not read; export it without"):
        load_mesh(glb(tmp_path / "a.glb", {}, extensionsRequired=needed))


def test_parts_of_a_scene_become_one_mesh(tmp_path):
    boxes = [trimesh.creation.box((1, 1, 1)).apply_translation((shift, 0, 0)) for shift in (0.0, 5.0)]
    trimesh.Scene(boxes).export(tmp_path / "two.glb")
    mesh = load_mesh(tmp_path / "two.glb")
    assert len(mesh.faces) == 24
    assert mesh.extents == pytest.approx((6, 1, 1))


def test_up_is_y_in_glb_files(tmp_path):
    tower = trimesh.creation.box((1, 9, 2)).apply_translation((0, 4.5, 0.5))  # as any program for glTF draws it
    tower.export(tmp_path / "tower.glb")
    mesh = load_mesh(tmp_path / "tower.glb")
    assert mesh.bounds == pytest.approx(np.array([[-0.5, -1.5, 0], [0.5, 0.5, 9]]))


def test_bad_faces_are_dropped_with_their_number(tmp_path):
    text = SQUARE + "v nan 0 0\nf 1 2 3\nf 1 3 4\nf 3 2 1\nf 1 1 2\nf 1 2 5\n"  # doubled, degenerate, not finite
    path = write(tmp_path / "dirty.obj", text)
    with pytest.warns(SarsplatWarning, match="dropped 2 of 5 faces"):
        mesh = load_mesh(path)
    assert len(mesh.faces) == 2
    assert np.isfinite(mesh.vertices).all()


def test_one_of_two_equal_faces_is_kept_without_a_warning(tmp_path):
    """Two bodies that touch share a triangle with other vertex numbers: the surface is the same without its copy."""
    triangle = "v 0 0 0\nv 2 0 0\nv 0 2 0\n"
    path = write(tmp_path / "soup.obj", triangle + triangle + "f 1 2 3\nf 5 6 4\n")
    assert len(load_mesh(path).faces) == 1


@pytest.mark.parametrize("scale", [1000.0, 39.4, 0.01])
def test_other_units_are_suspected(scale):
    box = trimesh.creation.box((7 * scale, 3 * scale, 2 * scale))
    (message,) = suspicious_size(box, paper_grid())
    assert "give `scale`" in message
    assert suspicious_size(scaled(box, 1 / scale), paper_grid()) == []


@pytest.mark.parametrize("size", [0.02, 0.5, 128.0])
def test_a_target_of_any_size_is_fine_if_its_images_are(size):
    grid = ImageGrid(128, 128, (size / 60, size / 60), (size / 50, size / 50))
    assert suspicious_size(trimesh.creation.box((size, size / 3, size / 4)), grid) == []


@pytest.mark.skipif(not REAL_MESHES.is_dir(), reason=f"{REAL_MESHES} is absent")
def test_real_meshes_load():
    files = sorted(REAL_MESHES.glob("*.obj"))
    assert files
    for file in files:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SarsplatWarning)  # dropped faces are expected of some
            mesh = load_mesh(file)
        assert len(mesh.faces) > 100
        assert 5 < mesh.extents.max() < 12
        assert mesh.bounds[0, 2] == pytest.approx(0, abs=0.05)
