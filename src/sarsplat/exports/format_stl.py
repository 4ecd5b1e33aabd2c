"""`.stl`: a mesh as triangles alone, for printers and solid modelling; it has no colours."""

from sarsplat.exports.format import mesh_format

_HEADER, _TRIANGLE = 84, 50  # bytes

FORMAT = mesh_format(lambda head, size: size == _HEADER + _TRIANGLE * int.from_bytes(head[80:84], "little"))
