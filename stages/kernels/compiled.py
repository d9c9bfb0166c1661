"""A typed `njit`: hot loops compile once, are cached on disk (flow/compile_cache.py) and release the GIL.

Source: ours; numba's decorator has no types, this one keeps the function's own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from flow.compile_cache import keep_compiled

F = TypeVar("F", bound=Callable[..., Any])

COMPILED = ("stages/kernels", "links/simulated/kernels")  # where such code is
CACHE_FOLDER = keep_compiled(COMPILED)


def compiled(function: F) -> F:
    """`numba.njit(cache=True, nogil=True)`: IEEE arithmetic, so that two machines agree."""
    return cast(F, numba.njit(cache=True, nogil=True)(function))  # pyright: ignore


def compiled_at_once(types: str) -> Callable[[F], F]:
    """`compiled`, for arguments of these types when its module is loaded; for others at the first call.

    For what is first called in flight, and not before by `links/runs/warm_up.py`: "(float64[::1], float64)".
    """

    def compile_now(function: F) -> F:
        dispatcher = compiled(function)
        cast(Any, dispatcher).compile(types)
        return dispatcher

    return compile_now
