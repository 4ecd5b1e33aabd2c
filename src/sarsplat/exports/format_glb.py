"""`.glb`: a mesh as binary glTF."""

from sarsplat.exports.format import Format
from sarsplat.exports.meshes import write_mesh_of

FORMAT = Format(
    writers={"mesh": write_mesh_of},
    opened_with={"mesh": "any mesh viewer"},
    recognises=lambda head, _: head.startswith(b"glTF"),
)
