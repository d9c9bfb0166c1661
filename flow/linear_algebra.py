"""One OpenBLAS kernel on every x86-64 processor, so that a replay gives the same bits on all of them.

OpenBLAS selects its kernels by the processor; those with AVX-512 sum the terms of a product in another order.
"""

from __future__ import annotations

import os
import platform
from pathlib import Path

CORE_TYPE = "OPENBLAS_CORETYPE"  # read by OpenBLAS when numpy or scipy is loaded
CPU_INFO = Path("/proc/cpuinfo")


def use_portable_kernel(environment: os._Environ[str] | dict[str, str] = os.environ, cpu_info: Path = CPU_INFO) -> None:
    """Select the kernel for AVX2 where the processor has it, unless the environment selects one.

    Without effect on what is loaded already. Child processes inherit it.
    """
    if platform.machine() not in ("x86_64", "AMD64") or not cpu_info.exists():
        return
    if "avx2" in cpu_info.read_text(errors="replace").split():
        environment.setdefault(CORE_TYPE, "Haswell")
