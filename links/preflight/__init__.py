"""Preflight: check that everything a configuration declares is present, healthy and agrees on the axes. Go or no-go."""
