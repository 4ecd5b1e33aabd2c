"""Ways to spoil a file: some know only of bytes, numbers and lines, some of JSON."""

import json
import random
import re
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

Mutation = Callable[[bytes, random.Random], bytes]

NUMBERS = [0, 1, -1, 2, 3, 4, 7, 127, 128, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 10**12]
FLOATS = [0.0, -0.0, 1e-45, 1e-30, 1.0, -1.0, 1e9, 3e38, 1e300, float("inf"), float("-inf"), float("nan")]
WORDS = [
    b"\xef\xbb\xbf", b"\0", b"\r\n", b"\n", b"\x0b", b"\x1b[31m", b"\xff\xfe", b"nan", b"inf", b"-1", b"1e309",
    b"99999999999", b"comment end_header\n", b"element vertex 1000000000\n", b"comment \x0belement a 0\n",
    b"property list uchar int i\n", b"element edge 9\n", b"property double x\n", b"end_header\n", b"usemtl a\n",
    b"mtllib ../../etc/passwd\n", b"f -1 -2 -3\n", b"f 1 2 999999999\n", b"o a\ng b\n", b"endsolid\nsolid\n",
    b"vertex ", b"OFF\n", b"999999999 999999999 0\n", b'"uri":"file:///etc/passwd",', b"NumberOfRows= 4096\n",
    b"PhoenixHeaderLength= 99999\n", b"[EndofPhoenixHeader]\n",
]  # fmt: skip


def spoil_bytes(data: bytes, rng: random.Random) -> bytes:
    """One change that knows only of bytes, numbers in them, numbers in text, and lines."""
    place = rng.randrange(len(data) + 1)
    if rng.random() < 0.5:
        place = min(place, rng.randrange(400))  # headers are where it hurts
    length = rng.choice((1, 2, 4, 8, 32, 500))
    match rng.randrange(10):
        case 0:
            return data[:place]
        case 1:
            return data[:place] + bytes(rng.randrange(256) for _ in range(rng.choice((1, 1, 4)))) + data[place + 1 :]
        case 2:
            return data[:place] + data[place + length :]
        case 3:
            return data[:place] + data[place : place + length] * rng.choice((2, 3, 50)) + data[place + length :]
        case 4:
            number, code = rng.choice(NUMBERS), rng.choice(("<I", ">I", "<H", ">H", "<Q", ">Q", "<B"))
            size = struct.calcsize(code)
            return data[:place] + struct.pack(code, number % 256**size) + data[place + size :]
        case 5:
            value, code = rng.choice(FLOATS), rng.choice(("<f", ">f", "<d"))
            place -= place % 4
            with np.errstate(over="ignore"):
                packed = np.array(value).astype(code).tobytes()
            return data[:place] + packed + data[place + len(packed) :]
        case 6:
            return data[:place] + rng.choice(WORDS) + data[place:]
        case 7:
            found = list(re.finditer(rb"-?\d+(\.\d+)?", data[:100_000]))
            if not found:
                return data + b"0"
            here = rng.choice(found)
            return data[: here.start()] + str(rng.choice(NUMBERS + FLOATS)).encode() + data[here.end() :]
        case 8:
            lines = data.split(b"\n")
            first, second = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[first] = rng.choice((lines[second], lines[first] + b"\n" + lines[first], b"", lines[first][::-1]))
            return b"\n".join(lines)
        case _:
            return rng.choice(
                (data.replace(b"\n", b"\r\n"), data.replace(b"\n", b"\r"), b"\xef\xbb\xbf" + data, data * 2)
            )


VALUES: list[Any] = [
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**400, 0.5, -1.5, 1e-300, 1e300, float("nan"), "", "x" * 300,
    "\ud800", "a\0b", "../x", "/etc/passwd", "/dev/zero", ".", "images/./000.tif", "train", "test\n", "\x1b[2J", [],
    {}, [[]], [0, 0], ["a"], {"a": 0}, "@deep", "@wide", "@twice",
]  # fmt: skip


def spoil_json(data: bytes, rng: random.Random) -> bytes:
    """One value of the JSON replaced, removed, moved, nested deeply, made wide, or its field named twice."""
    try:
        value = json.loads(data)
        places = list(_places(value))
        node, key = rng.choice(places)
        match rng.randrange(6):
            case 0:
                del node[key]
            case 1:
                other, where = rng.choice(places)
                node[key] = json.loads(json.dumps(other[where]))
            case 2 if isinstance(node, dict):
                node[rng.choice(("new", "", "\ud800", "x" * 200))] = node.pop(key)
            case _:
                node[key] = rng.choice(VALUES)
        text = json.dumps(value)
    except (ValueError, LookupError, RecursionError):  # spoilt before, or nothing in it
        return spoil_bytes(data, rng)
    text = text.replace('"@deep"', "[" * (depth := rng.choice((50, 900, 100_000))) + "]" * depth)
    text = text.replace('"@wide"', "[" + rng.choice(("0,", "[],", "{},", '"a",')) * rng.choice((9, 30_000)) + "0]")
    return text.replace('"@twice"', '{"a":1,"a":2}').encode()


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Every value of some JSON, as what holds it and its key or index there."""
    for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
        yield node, key
        yield from _places(node[key])
