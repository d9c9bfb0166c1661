"""The command `grd`. Exit codes: 0 success, 1 failed run or check, 2 usage or configuration error."""

from links.cli.app import main

__all__ = ["main"]
