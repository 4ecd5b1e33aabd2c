"""`.glb`: a mesh as binary glTF."""

from sarsplat.exports.format import mesh_format

FORMAT = mesh_format(lambda head, _: head.startswith(b"glTF"))
