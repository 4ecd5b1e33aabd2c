"""Meshes: files that are clean, dirty or foreign, faces with many corners, and random points of a surface."""

import itertools
import json
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sarsplat import ImageGrid, SarsplatError, SarsplatWarning, load_mesh, paper_grid
from sarsplat.scenes._polygons import are_fans, triangulated
from sarsplat.scenes.meshes import scaled, suspicious_size
from sarsplat.scenes.surface_samples import blocks_of_samples, surface_samples

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


def test_indices_may_be_relative_lines_indented_and_comments_end_in_a_backslash(tmp_path):
    """As programs do that write a file face by face, each after its corners; the numbers of texture count likewise."""
    lines = ["mtllib a.mtl", "vt 0 0"]
    for quad in QUADS:
        lines += ["v {} {} {}".format(*BOX.vertices[k]) for k in quad]
        lines += ["vn 0 0 1", "usemtl grey", "f -4/-1/-1 -3/-1/-1 \\", " -2/1/-1 -1/-1/-1 # a side"]
    for ends in ("\n", "\r\n", "\r"):
        (tmp_path / "box.obj").write_bytes(ends.join([*lines, ""]).encode())
        check_box(tmp_path / "box.obj")
    lines = ["# C:\\models\\", *("\tv {} {} {}".format(*vertex) for vertex in BOX.vertices)]
    lines += [" f {} {} {} {} # a side".format(*(k + 1 for k in quad)) for quad in QUADS]
    check_box(write(tmp_path / "box.obj", "\n".join([*lines, ""])))


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1 2 0", "f 1/1 00/1 2/1", "f 0 -1 -2", "f -9 1 2"])
def test_faces_of_vertices_that_there_are_not_are_refused(tmp_path, face):
    """Trimesh takes 0 for the last vertex."""
    path = write(tmp_path / "a.obj", f"{SQUARE}vt 0 0\nf 1 2 3\n{face}\n")
    with pytest.raises(SarsplatError, match=r"a\.obj' has faces that refer to missing vertices"):
        load_mesh(path)


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
    with pytest.raises(SarsplatError, match=r"a\.glb' holds Gaussians"):
        load_mesh(glb(tmp_path / "a.glb", {}, extensionsUsed=["KHR_gaussian_splatting"]))
    needed = ["KHR_materials_unlit", "EXT_mesh_gpu_instancing"]
    with pytest.raises(SarsplatError, match="needs EXT_mesh_gpu_instancing, which is not read; export it without"):
        load_mesh(glb(tmp_path / "a.glb", {}, extensionsRequired=needed))
    for more, told in (({"extensions": {needed[1]: {}}}, needed[1]), ({"weights": [0.5]}, "morph targets")):
        with pytest.raises(SarsplatError, match=f"{told}.* not read.*; export it"):
            load_mesh(glb(tmp_path / "a.glb", {}, nodes=[{"mesh": 0, **more}]))


def test_parts_of_a_scene_become_one_mesh_and_up_is_y_in_glb_files(tmp_path):
    towers = [trimesh.creation.box((1, 9, 2)).apply_translation((x, 4.5, 0.5)) for x in (0.0, 5.0)]  # as glTF has it
    trimesh.Scene(towers).export(tmp_path / "two.glb")
    mesh = load_mesh(tmp_path / "two.glb")
    assert len(mesh.faces) == 24
    assert mesh.bounds == pytest.approx(np.array([[-0.5, -1.5, 0], [5.5, 0.5, 9]]))


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
def test_other_units_are_suspected_unless_images_are_as_large(scale):
    box = trimesh.creation.box((7 * scale, 3 * scale, 2 * scale))
    (message,) = suspicious_size(box, paper_grid())
    assert "give `scale`" in message
    assert suspicious_size(scaled(box, 1 / scale), paper_grid()) == []
    assert suspicious_size(box, ImageGrid(128, 128, *2 * [(0.12 * scale, 0.12 * scale)])) == []


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


# ---- faces with more than three corners ------------------------------------------------------------------------------
L_SHAPE = np.array([(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)], float)
COMB = np.array([(0, 0), (9, 0), (9, 5), (8, 5), (8, 1), (5, 1), (5, 5), (4, 5), (4, 1), (1, 1), (1, 5), (0, 5)], float)
ARROW = np.array([(0, 0), (4, 0), (1, 1), (0, 4)], float)
T_CORNERS = np.array([(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (2, 1), (2, 3), (1, 3), (1, 2), (1, 1), (0, 1)], float)
# a square with a square hole, whose outline goes in and comes back along the same line
KEYHOLE = np.array([(0, 0), (6, 0), (6, 6), (0, 6), (0, 0), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2)], float)
SHAPES = [(L_SHAPE, 7.0), (COMB, 21.0), (ARROW, 4.0), (T_CORNERS, 5.0), (KEYHOLE, 32.0)]


def tilted(outline: np.ndarray) -> np.ndarray:
    """Corners on a steep plane, far from the origin as on a map."""
    turn = Rotation.from_euler("xyz", (50, 20, 70), degrees=True).as_matrix()
    return np.column_stack([outline, np.zeros(len(outline))]) @ turn.T + (5e5, 5e6, 300)


def area_of(corners: np.ndarray, triangles: np.ndarray) -> float:
    first, second, third = (corners[triangles[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2)


@pytest.mark.parametrize(("outline", "area"), SHAPES)
def test_ears_cover_what_an_outline_encloses_wherever_it_begins(outline, area):
    for begin, step in itertools.product(range(len(outline)), (1, -1)):
        corners = tilted(np.roll(outline[::step], begin, axis=0))
        triangles, crossed = triangulated(corners[None])
        assert area_of(corners, np.array(triangles[0])) == pytest.approx(area, rel=1e-6)
        assert crossed == 0


def test_ears_cover_outlines_of_any_shape():
    """Stars with random arms, some hundred corners, all at once."""
    generator = np.random.default_rng(0)
    angle = np.sort(generator.uniform(0, 2 * np.pi, (10, 150)), axis=1)
    radius = generator.uniform(0.05, 10, angle.shape)
    outlines = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=2)
    triangles, crossed = triangulated(outlines)
    x, y = outlines[..., 0], outlines[..., 1]
    enclosed = np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(axis=1)) / 2
    covered = [area_of(outline, np.array(own)) for outline, own in zip(outlines, triangles, strict=True)]
    assert covered == pytest.approx(enclosed, rel=1e-9)
    assert crossed == 0


def test_a_warped_face_has_one_diagonal_wherever_it_begins():
    saddle = np.array([(0, 0, 0), (1, 0, 1), (1, 1, 0), (0, 1, 1.0)])  # both diagonals are equally long
    surfaces = set()
    for begin in range(4):
        corners = np.roll(saddle, begin, axis=0)
        assert not are_fans(corners[None])[0]
        middles = sorted(corners[t].mean(axis=0).round(6).tolist() for t in triangulated(corners[None])[0][0])
        surfaces.add(str(middles))
    assert len(surfaces) == 1


def test_flat_convex_faces_remain_fans():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    assert are_fans(tilted(np.column_stack([np.cos(angle), np.sin(angle)]))[None]).all()
    pentagram = np.column_stack([np.cos(2 * angle[:5] * 12 / 5), np.sin(2 * angle[:5] * 12 / 5)])
    assert not are_fans(tilted(pentagram)[None]).any()
    assert not are_fans(tilted(L_SHAPE)[None]).any()


def files_of(outline: np.ndarray) -> dict[str, bytes]:
    """A wall and a triangle, in every format that has polygons, as programs write them."""
    many = len(outline)
    vertices = [*np.column_stack([outline, np.full(many, 2.0)]), (50, 0, 0), (52, 0, 0), (50, 2, 0)]
    places = "".join("{} {} {}\n".format(*vertex) for vertex in vertices)
    first, second = list(range(many)), [many, many + 1, many + 2]
    head = f"element vertex {many + 3}\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\n"
    text = "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in (first, second))
    files = {
        "a.obj": "".join(f"v {line}\n" for line in places.splitlines()) + "vt 0 0\ns 1\n"
        f"f {' '.join(f'{k + 1}/1' for k in first)}\r\nusemtl b\nf {' '.join(f'{k + 1}/1' for k in second)}\n",
        "a.off": f"OFF\n{many + 3} 2 0\n{places}{text}",
        "text.ply": f"ply\nformat ascii 1.0\n{head}end_header\n{places}{text}",
    }
    written = {name: content.encode() for name, content in files.items()}
    for order, name in (("<", "little"), (">", "big")):
        body = np.array(vertices, f"{order}f4").tobytes()
        for face in (first, second):
            body += bytes([len(face)]) + np.array(face, f"{order}i4").tobytes()
        written[f"{name}.ply"] = f"ply\r\nformat binary_{name}_endian 1.0\r\n{head}end_header\n".encode() + body
    return written


@pytest.mark.parametrize("name", ["a.obj", "a.off", "text.ply", "little.ply", "big.ply"])
@pytest.mark.parametrize(("outline", "area"), SHAPES)
def test_concave_faces_of_files_have_their_area(tmp_path, name, outline, area):
    for begin in (0, 3):
        (tmp_path / name).write_bytes(files_of(np.roll(outline, begin, axis=0))[name])
        assert load_mesh(tmp_path / name).area == pytest.approx(area + 2, rel=1e-6)


def test_an_outline_that_crosses_itself_is_said(tmp_path):
    (tmp_path / "bow.obj").write_text("v 0 0 0\nv 2 2 0\nv 2 0 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.warns(SarsplatWarning, match=r"bow\.obj': the outlines of 1 face cross themselves"):
        load_mesh(tmp_path / "bow.obj")


def test_far_too_many_corners_are_refused_at_once(tmp_path):
    comb = "".join(f"v {k} {k % 2 * 5} 0\n" for k in range(3000)) + "v 3000 -5 0\nv 0 -5 0\n"
    (tmp_path / "comb.obj").write_text(comb + f"f {' '.join(str(k + 1) for k in range(3002))}\n")
    with pytest.raises(SarsplatError, match=r"comb\.obj' has 1 concave faces with 3,002 corners"):
        load_mesh(tmp_path / "comb.obj")


# ---- random points of a surface, as trimesh draws them ---------------------------------------------------------------
@pytest.mark.parametrize("count", [1, 40_000])
def test_they_are_those_of_trimesh(count: int) -> None:
    mesh = trimesh.creation.icosphere(3)
    mesh.vertices[:, 0] *= 50.0  # faces of very different areas
    places, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    np.testing.assert_array_equal(surface_samples(mesh, count, np.random.default_rng(0)), places)
    blocks = blocks_of_samples(mesh, count, np.random.default_rng(0))
    np.testing.assert_array_equal(np.concatenate([face for _, _, face in blocks]), faces)


def test_weights_a_generator_in_use_and_a_mesh_without_area_are_taken() -> None:
    mesh = trimesh.creation.box()
    weight, chances = mesh.area_faces * (np.arange(12) == 7), [np.random.default_rng(0) for _ in range(2)]
    for _ in range(2):
        places, _ = trimesh.sample.sample_surface(mesh, 1000, weight, seed=chances[0])
        np.testing.assert_array_equal(surface_samples(mesh, 1000, chances[1], weight), places)
    point = trimesh.Trimesh([[1.0, 2.0, 3.0]] * 3, [[0, 1, 2]], process=False)
    np.testing.assert_array_equal(surface_samples(point, 2, np.random.default_rng(0)), [[1.0, 2.0, 3.0]] * 2)
