"""Runs the command line in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from links.cli.app import app


def grd(*arguments: object, code: int = 0) -> str:
    """Output of `grd ARGUMENTS`, which must end with this exit code. An unexpected exception is raised."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output
