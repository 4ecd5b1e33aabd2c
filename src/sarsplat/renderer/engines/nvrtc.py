"""Compilation of the CUDA engine at first use, with NVRTC from torch's CUDA builds, and the cache of it on disk."""

import ctypes
import hashlib
import os
import sys
import warnings
from collections.abc import Mapping
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import get_ident

import torch

from sarsplat.errors import SarsplatError, SarsplatWarning
from sarsplat.renderer.engines.abi import SOURCES

MAIN = "kernels.cu"
"""Source that includes all others."""

_OPTIONS = ("--std=c++17",)

# NVRTC has no standard library; the source needs only these types
_CSTDINT = """#pragma once
typedef short int16_t;
typedef int int32_t;
typedef unsigned int uint32_t;
typedef long long int64_t;
"""

if sys.platform == "win32":
    _PLACES, _LIBRARY, _BUILTINS = ("bin", "bin/x86_64"), "nvrtc64_*0_0.dll", "nvrtc-builtins64_*[0-9].dll"
    _SYSTEMS = "nvrtc64_{}0_0.dll"
else:
    _PLACES, _LIBRARY, _BUILTINS = ("lib",), "libnvrtc.so.*", "libnvrtc-builtins.so.*"
    _SYSTEMS = "libnvrtc.so.{}"

_REMEDY = "install a torch built for CUDA, which brings it along, or use the CPU"


def sources() -> dict[str, str]:
    """Read every file that the engine's source includes, by name."""
    paths = (SOURCES / MAIN, *sorted(SOURCES.glob("cuda_*.cuh")))
    shared = (SOURCES / "api.h", *sorted(SOURCES.glob("*_math.h")))
    return {path.name: path.read_text(encoding="utf-8") for path in (*paths, *shared)} | {"cstdint": _CSTDINT}


def machine_code(architecture: str, compiler: "Nvrtc") -> bytes:
    """Return the engine for one architecture ("sm_90"), from the user's cache folder or compiled now."""
    text = sources()
    key = hashlib.sha256(repr((sorted(text.items()), architecture, compiler.version, _OPTIONS)).encode()).hexdigest()
    name = f"{architecture}-{key[:32]}.cubin"
    if (code := read_cached(name)) is None:
        code = compiler.compile(text, architecture)
        write_cached(name, code)
    return code


class Nvrtc:
    """NVIDIA's run-time compiler, through ctypes; raises if it is not installed."""

    def __init__(self) -> None:
        self._library = _load()
        major, minor = c_int(), c_int()
        self._check(self._library.nvrtcVersion(byref(major), byref(minor)))
        self.version, self.log = f"{major.value}.{minor.value}", ""

    def compile(self, sources: Mapping[str, str], architecture: str, *more: str) -> bytes:
        """Compile `MAIN` and the headers beside it, with `more` options; the output is in `log` and in errors."""
        headers = [name for name in sources if name != MAIN]
        texts = (c_char_p * len(headers))(*(sources[name].encode() for name in headers))
        names = (c_char_p * len(headers))(*(name.encode() for name in headers))
        program = c_void_p()
        self._check(
            self._library.nvrtcCreateProgram(
                byref(program), sources[MAIN].encode(), MAIN.encode(), len(headers), texts, names
            )
        )
        try:
            options = (*_OPTIONS, f"--gpu-architecture={architecture}", *more)
            status = self._library.nvrtcCompileProgram(
                program, len(options), (c_char_p * len(options))(*(option.encode() for option in options))
            )
            self.log = self._text(program, "ProgramLog").rstrip(b"\0").decode(errors="replace").strip()
            if status:
                raise SarsplatError(
                    f"NVRTC {self.version} cannot compile the CUDA engine for {architecture} "
                    f"({self.log.partition(chr(10))[0] or self._reason(status)}); install a torch whose CUDA knows "
                    "this device, or use the CPU"
                )
            return self._text(program, "CUBIN")
        finally:
            self._library.nvrtcDestroyProgram(byref(program))

    def _text(self, program: c_void_p, what: str) -> bytes:
        size = c_size_t()
        self._check(getattr(self._library, f"nvrtcGet{what}Size")(program, byref(size)))
        buffer = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, f"nvrtcGet{what}")(program, buffer))
        return buffer.raw

    def _reason(self, status: int) -> str:
        return self._library.nvrtcGetErrorString(status).decode()

    def _check(self, status: int) -> None:
        if status:
            raise SarsplatError(f"NVRTC failed ({self._reason(status)}); {_REMEDY}")


def _candidates() -> list[Path]:
    """Return paths of NVRTC in wheels and in torch, those of torch's CUDA version first, then the system's."""
    own = (torch.version.cuda or "").partition(".")[0]
    spec = find_spec("nvidia")
    wheels = [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []
    folders = [folder for wheel in wheels for place in _PLACES for folder in wheel.glob(f"*/{place}")]
    folders.append(Path(torch.__file__).with_name("lib"))
    paths = [path for folder in folders for path in sorted(folder.glob(_LIBRARY)) if ".alt." not in path.name]
    first = _LIBRARY.replace("*", own)
    return [*sorted(paths, key=lambda path: not path.match(first)), Path(_SYSTEMS.format(own).removesuffix("."))]


@cache
def _load() -> ctypes.CDLL:
    """Load the first of the candidates that can be loaded."""
    faults = []
    for path in _candidates():
        try:
            if path.is_absolute():
                for builtins in path.parent.glob(_BUILTINS):  # NVRTC asks for it by name alone
                    ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
            library = ctypes.CDLL(str(path))
        except OSError as error:
            faults.append(str(error))
            continue
        library.nvrtcGetErrorString.restype = c_char_p
        library.nvrtcCreateProgram.argtypes = [
            *(POINTER(c_void_p), c_char_p, c_char_p, c_int, POINTER(c_char_p), POINTER(c_char_p))
        ]
        return library
    raise SarsplatError(f"NVRTC, which compiles the CUDA engine, cannot be loaded ({'; '.join(faults)}); {_REMEDY}")


# ---- cache on disk, in $XDG_CACHE_HOME/sarsplat or ~/.cache/sarsplat -------------------------------------------------
def read_cached(name: str) -> bytes | None:
    """Return cached content; None if it is missing or its checksum is wrong."""
    try:
        content = (_folder() / name).read_bytes()
    except OSError:
        return None
    digest, payload = content[:32], content[32:]
    return payload if hashlib.sha256(payload).digest() == digest else None


def write_cached(name: str, content: bytes) -> None:
    """Cache content; warn once if the folder is not writable."""
    folder = _folder()
    temporary = folder / f"{name}.{os.getpid()}-{get_ident()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
        temporary.replace(folder / name)
    except OSError as error:
        _warn(folder, str(error))


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sarsplat"


@cache
def _warn(folder: Path, reason: str) -> None:
    warnings.warn(
        f"the compiled CUDA engine and its check cannot be kept in {folder} ({reason}), so that every program begins "
        "with them; make it writable, or name another folder in XDG_CACHE_HOME",
        SarsplatWarning,
        stacklevel=2,
    )
