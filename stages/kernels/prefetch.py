"""`prefetch`, which fetches an array element into the cache before compiled code needs it.

Source: ours; LLVM Language Reference Manual, llvm.prefetch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # pyright: ignore[reportMissingTypeStubs]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

FOR_WRITING, KEPT, DATA = 1, 3, 1  # arguments of llvm.prefetch: access, locality, cache


def _typed(context: Any, array: Any, index: Any) -> Any:
    """Fetch element `index` of a contiguous array; it may lie outside of the array: that has no effect."""

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        first = target.make_array(signature.args[0])(target, builder, values[0]).data
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        called = builder.module.declare_intrinsic(
            "llvm.prefetch", [byte], ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        )
        at = builder.bitcast(builder.gep(first, [values[1]]), byte)
        builder.call(called, [at, number(FOR_WRITING), number(KEPT), number(DATA)])
        return target.get_dummy_value()

    return types.void(array, types.uint64), generate


prefetch: Callable[[NDArray[Any], np.uint64], None] = intrinsic(_typed)  # pyright: ignore
