"""Kernels of OpenBLAS and numpy: the same on all x86-64 processors, chosen before numpy is loaded."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from flow import NUMPY, OPENBLAS, THREADS, use_portable_kernels

x86_only = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="kernels of x86-64")


def selected(tmp_path, flags, **environment):
    cpu_info = tmp_path / "cpuinfo"
    cpu_info.write_text(f"processor: 0\nflags: fpu {flags} sse2\n")
    use_portable_kernels(environment, cpu_info)
    return environment.get(OPENBLAS), environment.get(NUMPY)


@x86_only
@pytest.mark.parametrize(
    ("flags", "kernels"),
    [
        ("avx", (None, None)),
        ("avx2", ("Haswell", None)),
        ("avx2 avx512f", ("Haswell", "X86_V4")),
        ("avx2 avx512f avx512_vbmi2 avx512_fp16", ("Haswell", "X86_V4 AVX512_ICL AVX512_SPR")),
    ],
)
def test_the_kernels_for_avx2_are_used_where_the_processor_has_it(tmp_path, flags, kernels):
    assert selected(tmp_path, flags) == kernels


@pytest.mark.parametrize(("chosen", "threads"), [({}, "1"), ({THREADS: "4"}, "4")])
def test_blas_uses_one_thread_unless_the_user_chooses_another_number(tmp_path, chosen, threads):
    environment = dict(chosen)
    use_portable_kernels(environment, tmp_path / "none")
    assert environment[THREADS] == threads


@x86_only
def test_the_users_choice_remains(tmp_path):
    chosen = {OPENBLAS: "Zen", NUMPY: "X86_V3"}
    assert selected(tmp_path, "avx2 avx512f", **chosen) == tuple(chosen.values())


def test_other_machines_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert selected(tmp_path, "avx2 avx512f") == (None, None)


@x86_only
def test_the_command_line_selects_them_before_numpy_is_loaded():
    program = f"""
import os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print("numpy is loaded with", os.environ.get("{OPENBLAS}"), os.environ.get("{THREADS}"), "thread")

sys.meta_path.insert(0, Watch())
import links.cli, links.evaluation.errors
"""
    environment = {name: value for name, value in os.environ.items() if name not in (OPENBLAS, NUMPY, THREADS)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    expected: dict[str, str] = {}
    use_portable_kernels(expected)
    assert f"numpy is loaded with {expected.get(OPENBLAS)} 1 thread" in done.stdout
