"""Memory of another process, mapped read-only.

`mmap.mmap` keeps a descriptor open for each mapping (unless told otherwise, from Python 3.13 on),
and a node may keep a thousand images: mmap(2) by itself needs none.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import os
import weakref
from collections.abc import Callable

_FAILED = ctypes.c_void_p(-1).value
_FLAGS = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)


def map_file(descriptor: int, size: int, on_unmap: Callable[[], object] | None) -> memoryview:
    """Return the contents of a file, read-only; mapped for as long as anybody looks into it.

    Args:
        descriptor: The file's; may be closed afterwards.
        size: How much of it, from its start [bytes].
        on_unmap: Called when nobody looks into it any more, on whichever thread stops to.

    Raises:
        OSError: It cannot be mapped.
    """
    libc = _libc()
    address = libc.mmap(None, size, mmap.PROT_READ, _FLAGS, descriptor, 0)
    if address == _FAILED:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    contents = (ctypes.c_ubyte * size).from_address(address)
    # What is returned, and each part of it, refers to `contents`.
    weakref.finalize(contents, _unmap, address, size, on_unmap).atexit = False
    return memoryview(contents).toreadonly().cast("B")


def _unmap(address: int, size: int, on_unmap: Callable[[], object] | None) -> None:
    _libc().munmap(address, size)
    if on_unmap is not None:
        on_unmap()


@functools.cache
def _libc() -> ctypes.CDLL:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = (
        ctypes.c_void_p,
        ctypes.c_size_t,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_long,
    )
    libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    return libc
