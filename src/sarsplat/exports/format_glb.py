"""`.glb`: a mesh as binary glTF."""

from sarsplat.exports.format import mesh_format

FORMAT = mesh_format(
    lambda head, _: head.startswith(b"glTF"),
    up="y up, as in all glTF: viewers see (x, z, -y) of the scene, by the file's node; its stored vertices are z up",
)
