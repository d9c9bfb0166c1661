"""The stage-graph engine: YAML in, checked graph, deterministic run. It knows nothing about drones.

It selects the same floating-point kernels on every x86-64 processor with AVX2, so that a replay gives the same bits.
OpenBLAS and numpy select theirs by the processor, and those for AVX-512 round differently: sums are in another order,
and exp, log, sin and cos are other polynomials. OpenBLAS uses one thread: the order of its sums depends on their
number, and on a busy machine its threads wait for each other, on small matrices much longer than they compute.
"""

from __future__ import annotations

import os
import platform
from collections.abc import MutableMapping
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")
OPENBLAS, NUMPY = "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"  # read when numpy or scipy is loaded
THREADS = "OPENBLAS_NUM_THREADS"
# flag of the processor: numpy's name (2.4) of the kernels that need it
NUMPY_KERNELS = {"avx512f": "X86_V4", "avx512_vbmi2": "AVX512_ICL", "avx512_fp16": "AVX512_SPR"}


def use_portable_kernels(environment: MutableMapping[str, str] = os.environ, cpu_info: Path = CPU_INFO) -> None:
    """Select one thread, and the kernels for AVX2 where the processor has it, unless the environment selects others.

    Without effect on what is loaded already. Child processes inherit it.
    """
    environment.setdefault(THREADS, "1")
    if platform.machine() not in ("x86_64", "AMD64") or not cpu_info.exists():
        return
    flags = set(cpu_info.read_text(errors="replace").split())
    if "avx2" not in flags:
        return
    environment.setdefault(OPENBLAS, "Haswell")
    if disabled := [kernels for flag, kernels in NUMPY_KERNELS.items() if flag in flags]:
        environment.setdefault(NUMPY, " ".join(disabled))


use_portable_kernels()
