"""`.obj`: a mesh as Wavefront text."""

from sarsplat.exports.format import mesh_format

FORMAT = mesh_format(lambda head, _: head.startswith(b"# sarsplat"))
