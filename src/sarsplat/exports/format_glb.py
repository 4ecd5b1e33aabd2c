"""`.glb`: a mesh, or Gaussians by the extension KHR_gaussian_splatting, as binary glTF."""

from sarsplat.data import write_bytes, write_mesh
from sarsplat.data.gltf_splats import glb_bytes
from sarsplat.exports.format import Format

FORMAT = Format(
    writers={
        "mesh": lambda mesh, path, _: write_mesh(path, mesh),
        "gaussians": lambda gaussians, path, colour: write_bytes(path, glb_bytes(gaussians, colour)),
    },
    opened_with={"mesh": "any mesh viewer", "gaussians": "viewers of glTF with KHR_gaussian_splatting"},
    recognises=lambda head, _: head.startswith(b"glTF"),
    up="y up, as in all glTF: viewers see (x, z, -y) of the scene, by the file's node; its stored vertices are z up",
)
