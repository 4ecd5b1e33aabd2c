"""OBJ files as trimesh understands them: lines that end in LF, and vertices that are counted from the first one."""

from __future__ import annotations

import re

from sarsplat.errors import SarsplatError

_RELATIVE = re.compile(rb"^f[^\n#]*[ \t/]-", re.MULTILINE)
_BACK = re.compile(rb"-[0-9]{1,12}")


def plain_obj(data: bytes) -> bytes:
    """The same file; refused if a face counts back beyond the first vertex."""
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not _RELATIVE.search(data):
        return data
    seen = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = []
    for line in data.replace(b"\\\n", b" ").split(b"\n"):
        words = line.partition(b"#")[0].split()
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
                raise SarsplatError("has faces that refer to missing vertices; repair the mesh")
            numbers[place] = b"%d" % (count + 1 + int(number))
    return b"/".join(numbers)
