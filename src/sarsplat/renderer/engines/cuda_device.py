"""NVIDIA GPU: launches of the engine's kernels through the driver, on torch's current stream, and arrays for them."""

from __future__ import annotations

import ctypes
import sys
import threading
from contextlib import nullcontext
from ctypes import POINTER, byref, c_char_p, c_int, c_uint, c_void_p
from functools import cache

import torch
from torch import Tensor

from sarsplat.errors import SarsplatError
from sarsplat.renderer.engines.nvrtc import Nvrtc, machine_code
from sarsplat.renderer.engines.on_device import kept_on_device

THREADS = 256
"""Threads of a block, as in csrc/cuda_state.cuh."""

_NON_BLOCKING = 1  # flag of streams that do not synchronise with the legacy default stream, as torch's streams
_COMPILING = threading.Lock()  # lock of the first use of a GPU: one thread compiles

_DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"


class Device:
    """Kernels of one GPU; raises if the driver, NVRTC or the device is missing."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._driver = _driver()
        self._context, module = c_void_p(), c_void_p()
        handle = c_int()
        self._check(self._driver.cuInit(0))
        self._check(self._driver.cuDeviceGet(byref(handle), device.index))
        self._check(self._driver.cuDevicePrimaryCtxRetain(byref(self._context), handle))  # torch's; never released
        self._check(self._driver.cuCtxSetCurrent(self._context))
        major, minor = torch.cuda.get_device_capability(device)
        code = machine_code(f"sm_{major}{minor}", Nvrtc())
        self._check(self._driver.cuModuleLoadData(byref(module), code))
        self._module = module
        self._kernels: dict[str, c_void_p] = {}
        version = c_int()
        self._check(self._driver.cuDriverGetVersion(byref(version)))
        self.description = f"{torch.cuda.get_device_name(device)}, sm_{major}{minor}, driver of CUDA {version.value}"

    def launch(self, name: str, blocks: int, threads: int, *arguments: ctypes._CData) -> None:
        """Queue a kernel after those before it; its arguments are C values."""
        elsewhere = torch.cuda.current_device() != self.device.index
        with torch.cuda.device(self.device) if elsewhere else nullcontext():
            self._check(self._driver.cuCtxSetCurrent(self._context))  # threads of autograd may not have it yet
            stream = torch.cuda.current_stream(self.device).cuda_stream
            addresses = (c_void_p * len(arguments))(*map(ctypes.addressof, arguments))
            self._check(
                self._driver.cuLaunchKernel(self._kernel(name), blocks, 1, 1, threads, 1, 1, 0, stream, addresses, None)
            )

    def new_stream(self) -> torch.cuda.ExternalStream:
        """Make an exclusive stream, never destroyed; torch's own are shared out of a pool of 32."""
        stream = c_void_p()
        self._check(self._driver.cuCtxSetCurrent(self._context))
        self._check(self._driver.cuStreamCreate(byref(stream), _NON_BLOCKING))
        return torch.cuda.ExternalStream(stream.value, device=self.device)

    def _kernel(self, name: str) -> c_void_p:
        if name not in self._kernels:
            kernel = c_void_p()
            self._check(self._driver.cuModuleGetFunction(byref(kernel), self._module, name.encode()))
            self._kernels[name] = kernel
        return self._kernels[name]

    def _check(self, status: int) -> None:
        if status:
            text = c_char_p()
            self._driver.cuGetErrorString(status, byref(text))
            raise SarsplatError(
                f"the CUDA driver failed with error {status} ({(text.value or b'unknown').decode()}); "
                "restart the program, update the driver, or use the CPU"
            )


def device(index: int) -> Device:
    """Return the GPU of this index; kernels are compiled and loaded once."""
    with _COMPILING:
        return _device(index)


@cache
def _device(index: int) -> Device:
    return Device(torch.device("cuda", index))


@cache
def require_cuda() -> None:
    """Raise, with the reason and the remedy, if torch cannot use a GPU."""
    if torch.version.cuda is None:
        raise SarsplatError(
            f"the CUDA engine needs a torch built for CUDA, and this is {torch.__version__}; install one, or use "
            "the CPU"
        )
    if not torch.cuda.is_available():
        raise SarsplatError(
            f"torch {torch.__version__} finds no usable NVIDIA GPU; install the driver that CUDA "
            f"{torch.version.cuda} needs (see nvidia-smi), or use the CPU"
        )


@cache
def _driver() -> ctypes.CDLL:
    try:
        driver = ctypes.CDLL(_DRIVER)
    except OSError as error:
        raise SarsplatError(f"the NVIDIA driver cannot be loaded ({error}); install it, or use the CPU") from error
    driver.cuModuleLoadData.argtypes = [POINTER(c_void_p), c_char_p]
    sizes = [c_uint] * 7  # grid, block, shared bytes
    driver.cuLaunchKernel.argtypes = [c_void_p, *sizes, c_void_p, POINTER(c_void_p), POINTER(c_void_p)]
    return driver


class Arrays:
    """Arrays by name, kept while kernels may read them, and the launcher of kernels."""

    def __init__(self, launcher: Device) -> None:
        self.launcher = launcher
        self.arrays: dict[str, Tensor] = {}

    def launch(self, name: str, blocks: int, *arguments: ctypes._CData) -> None:
        """Queue blocks of a kernel, unless there are 0."""
        if blocks:
            self.launcher.launch(name, blocks, THREADS, *arguments)

    def new(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Make an uninitialised array."""
        return self.keep(name, torch.empty(shape, dtype=dtype, device=self.launcher.device))

    def keep(self, name: str, array: Tensor) -> Tensor:
        """Keep an array, in place of one of the same name."""
        self.arrays[name] = array  # kernels hold its address only
        return array

    def sent(self, content: bytes) -> Tensor:
        """Return a cached copy on the device."""
        return _sent(content, self.launcher.device)


# The pixels of views never change, and a training renders the same few views again and again.
@kept_on_device(maxsize=256)
def _sent(content: bytes, device: torch.device) -> Tensor:
    """Copy to the device asynchronously, from pinned memory: copies of other memory synchronise."""
    array = torch.frombuffer(bytearray(content), dtype=torch.uint8)
    return (array.pin_memory() if device.type == "cuda" else array).to(device, non_blocking=True)
