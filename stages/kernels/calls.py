"""Which compiled functions a process has called with which types, so that a later one loads them before it calls one.

Numba compiles a function, or loads it from its cache, at its first call with new types.

Source: ours. The calls are a pickle, as are the files of numba's cache: read them from its folder only. Their SHA-256
comes first: a damaged file is not unpickled.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from typing import Any

import numba

from stages.kernels.compiled import CACHE_FOLDER, FUNCTIONS

FOLDER = CACHE_FOLDER  # numba's cache; its name depends on the source of all compiled functions
VERSION = numba.__version__
DIGEST_BYTES = 32


def calls_made() -> bytes:
    """The functions that this process has called, with their types."""
    made = pickle.dumps({_name(function): function.signatures for function in FUNCTIONS if function.signatures})
    return _digest(made) + made


def load_calls(calls: bytes, progress: Callable[[int, int], None]) -> bool:
    """Load the functions of `calls_made`; what numba's cache lacks is compiled. `progress` gets done and total.

    False: the calls are damaged, or a function does not exist.
    """
    functions = {_name(function): function for function in FUNCTIONS}
    digest, data = calls[:DIGEST_BYTES], calls[DIGEST_BYTES:]
    if digest != _digest(data):
        return False
    made: dict[tuple[str, str], Any] = pickle.loads(data)
    if made.keys() - functions.keys():
        return False
    for done, (name, signatures) in enumerate(made.items(), 1):
        for signature in signatures:
            if signature not in functions[name].overloads:  # a function of `compiled_at_once` takes no other types
                functions[name].compile(signature)
        progress(done, len(made))
    return True


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def _name(function: Any) -> tuple[str, str]:
    return function.py_func.__module__, function.py_func.__qualname__
