"""Typed decorators for numba: functions are compiled once, cached on disk (flow/compile_cache.py), without the GIL.

Source: ours; numba's decorator has no types, these keep the type of the function.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import config

from flow.compile_cache import folder_of

F = TypeVar("F", bound=Callable[..., Any])

COMPILED = ("stages/kernels", "links/simulated/kernels")  # folders with compiled functions
CACHE_FOLDER = folder_of(COMPILED)
config.CACHE_DIR = str(CACHE_FOLDER)  # pyright: ignore
FUNCTIONS: list[Any] = []  # all compiled functions of the imported modules: numba's dispatchers


def compiled(function: F) -> F:
    """`numba.njit(cache=True, nogil=True)`: IEEE arithmetic, so that two machines agree."""
    FUNCTIONS.append(numba.njit(cache=True, nogil=True)(function))  # pyright: ignore
    return cast(F, FUNCTIONS[-1])


def compiled_at_once(types: str) -> Callable[[F], F]:
    """`compiled`, but compiled for these argument types at import. TypeError for others: to compile takes seconds.

    For functions that are first called in flight and not by `links/runs/warm_up.py`: "(float64[::1], float64)".
    """

    def compile_now(function: F) -> F:
        dispatcher = compiled(function)
        cast(Any, dispatcher).compile(types)
        cast(Any, dispatcher).disable_compile()
        return dispatcher

    return compile_now
