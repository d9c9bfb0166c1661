"""All numba-compiled functions of the stages, and nothing else: the compile cache depends on this folder alone."""
