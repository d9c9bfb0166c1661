"""The command line as a user calls it, in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from links.cli.app import app


def grd(*words: object, code: int = 0) -> str:
    """What `grd WORDS` prints, when it ends with that exit code. An error it does not put into words is raised."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output
