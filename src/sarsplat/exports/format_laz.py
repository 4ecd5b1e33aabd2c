"""`.laz`: points as compressed LAS 1.4."""

from dataclasses import replace

from sarsplat.exports.format_las import FORMAT as LAS
from sarsplat.exports.format_las import write_las

FORMAT = replace(LAS, writers={"points": lambda points, path, _: write_las(points, path, compressed=True)})
