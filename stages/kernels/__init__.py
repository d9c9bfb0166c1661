"""Every numba-compiled function of the method, and nothing else: the compile cache depends on this folder alone."""
