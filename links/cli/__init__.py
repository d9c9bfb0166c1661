"""The command `grd`: thin commands over flow, stages and links. Exit codes: 0 ok, 1 a finding, 2 wrong use.

Source: DESIGN, Command line.
"""

from links.cli.app import main

__all__ = ["main"]
