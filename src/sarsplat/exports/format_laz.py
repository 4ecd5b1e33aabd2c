"""`.laz`: points as compressed LAS 1.4."""

from dataclasses import replace

from sarsplat.data import write_bytes
from sarsplat.exports.format_las import FORMAT as LAS
from sarsplat.exports.format_las import las_bytes

FORMAT = replace(LAS, writers={"points": lambda points, path, _: write_bytes(path, las_bytes(points, compressed=True))})
