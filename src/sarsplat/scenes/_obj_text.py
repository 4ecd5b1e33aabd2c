"""OBJ files as trimesh understands them: without comments and indentation, and vertices counted from the first one."""

from __future__ import annotations

import re

from sarsplat.errors import SarsplatError

_MISSING = "has faces that refer to missing vertices; repair the mesh"
_COMMENT = re.compile(rb"#[^\n]*")
_INDENTED = re.compile(rb"\n[ \t]+")
_RELATIVE = re.compile(rb"^f[^\n]*[ \t/]-", re.MULTILINE)
_ZERO = re.compile(rb"^f[^\n]*[ \t]0+(?![0-9])", re.MULTILINE)
_BACK = re.compile(rb"-[0-9]{1,12}")


def plain_obj(data: bytes) -> bytes:
    """The same file without comments, continued lines and indentation; refused if a face refers to no vertex.

    A comment may end with a backslash, as a folder of Windows does, without going on in the next line.
    """
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    data = _COMMENT.sub(b"", data).replace(b"\\\n", b" ")
    data = _INDENTED.sub(b"\n", data).lstrip()
    if _ZERO.search(data):  # for trimesh this is the last vertex
        raise SarsplatError(_MISSING)
    if not _RELATIVE.search(data):
        return data
    seen = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = []
    for line in data.split(b"\n"):
        words = line.split()
        if words and words[0] in seen:
            seen[words[0]] += 1
        elif words and words[0] == b"f":
            line = b" ".join([b"f", *(_corner(word, [*seen.values()]) for word in words[1:])])
        lines.append(line)
    return b"\n".join(lines)


def _corner(word: bytes, seen: list[int]) -> bytes:
    """A corner of a face, vertex/texture/normal, of which so many came before it: −1 is the last of them."""
    numbers = word.split(b"/")
    for place, (number, count) in enumerate(zip(numbers, seen, strict=False)):
        if _BACK.fullmatch(number):
            if not -count <= int(number) < 0:
                raise SarsplatError(_MISSING)
            numbers[place] = b"%d" % (count + 1 + int(number))
    return b"/".join(numbers)
