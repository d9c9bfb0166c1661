"""The kernels folder: the compile cache depends on it alone."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

from numba.core.registry import CPUDispatcher

from links.simulated import kernels


def test_kernels_define_compiled_functions_only():
    for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}."):
        loaded = importlib.import_module(module.name)
        own = [value for value in vars(loaded).values() if getattr(value, "__module__", None) == module.name]
        assert own, module.name
        assert all(isinstance(value, CPUDispatcher) for value in own if callable(value)), module.name
        assert not any(inspect.isclass(value) for value in own), module.name
