"""Numba functions of the simulator and the constants compiled into them; the compile cache depends on this folder."""
