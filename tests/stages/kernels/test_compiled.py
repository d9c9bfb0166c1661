"""The cache of compiled code: it must be invalidated by any change of a file whose code is in it."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core import config
from numba.core.registry import CPUDispatcher

import links.simulated.kernels
import stages.kernels
from flow.compile_cache import cache_folder, cache_name
from stages.kernels import calls, compiled
from stages.kernels.compiled import CACHE_FOLDER, COMPILED
from stages.kernels.geometry.so3 import nearly_rotation

REPOSITORY = Path(__file__).resolve().parents[3]


def test_the_name_changes_with_any_file_but_not_with_its_location(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name / "deep").mkdir(parents=True)
        (tmp_path / name / "caller.py").write_text("x = 1\n")
        (tmp_path / name / "deep" / "callee.py").write_text("y = 1\n")
    first = cache_name([tmp_path / "one"])
    assert first == cache_name([tmp_path / "other"])
    (tmp_path / "one" / "deep" / "callee.py").write_text("y = 2\n")  # same size: content decides
    assert cache_name([tmp_path / "one"]) != first


def test_every_compiled_function_is_in_a_folder_of_the_name():
    users = [path for package in ("flow", "links", "stages") for path in (REPOSITORY / package).rglob("*.py")]
    users = [path for path in users if "import compiled" in path.read_text(encoding="utf-8")]
    assert len(users) > 20
    assert [path for path in users if not any(REPOSITORY / folder in path.parents for folder in COMPILED)] == []


@pytest.mark.parametrize("kernels", [links.simulated.kernels, stages.kernels])
def test_kernels_define_compiled_functions_only(kernels):
    for module in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}."):
        loaded = importlib.import_module(module.name)
        own = [value for value in vars(loaded).values() if getattr(value, "__module__", None) == module.name]
        assert own or module.ispkg, module.name
        functions = [value for value in own if callable(value) and not inspect.isclass(value)]
        if loaded not in (compiled, calls):  # the decorators themselves, and what loads the functions
            assert all(isinstance(value, CPUDispatcher) for value in functions), module.name


def test_a_function_that_is_compiled_at_import_refuses_other_types_and_compiles_none():
    read_only = np.eye(3)
    read_only.setflags(write=False)
    assert np.allclose(nearly_rotation(np.eye(3)), np.eye(3))
    with pytest.raises(TypeError):
        nearly_rotation(read_only)
    assert len(nearly_rotation.signatures) == 1  # pyright: ignore


def test_numba_uses_it_and_a_folder_that_cannot_be_created_is_no_error(tmp_path, monkeypatch):
    assert str(CACHE_FOLDER) == config.CACHE_DIR
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    folder = cache_folder("abc")
    assert folder.name == "abc"
    assert tmp_path not in folder.parents


CALLEE = "from stages.kernels.compiled import compiled\n@compiled\ndef inner(x):\n    return x + {}\n"
CALLER = "from stages.kernels.compiled import compiled\nfrom callee import inner\n@compiled\ndef outer(x):\n    return inner(x)\n"


def test_a_changed_callee_in_another_file_is_detected(tmp_path):
    """With the cache named after these files; numba alone would keep the old code."""
    (tmp_path / "caller.py").write_text(CALLER)
    program = (
        "import sys, pathlib, stages.kernels.compiled, flow.compile_cache as c\nfrom numba.core import config\n"
        f"here = pathlib.Path({str(tmp_path)!r}); sys.path.insert(0, str(here))\n"
        "config.CACHE_DIR = str(here / 'cache' / (c.cache_name([here]) if sys.argv[1] == 'ours' else 'one'))\n"
        "from caller import outer\n"
        "print(outer(1))\n"
    )

    def answer(number, kind):
        (tmp_path / "callee.py").write_text(CALLEE.format(number))
        done = subprocess.run(
            [sys.executable, "-B", "-c", program, kind], cwd=REPOSITORY, capture_output=True, text=True, check=True
        )
        return int(done.stdout)

    assert [answer(1, "ours"), answer(2, "ours")] == [2, 3]
    assert [answer(1, "numba"), answer(2, "numba")] == [2, 2]
