"""Runs the command line in this process, and reads the service file that runs it on the vehicle."""

from __future__ import annotations

from configparser import ConfigParser
from pathlib import Path

from typer.testing import CliRunner

from links.cli.app import app

UNIT = Path(__file__).resolve().parents[1] / "deploy" / "grd.service"


def unit_file() -> ConfigParser:
    """Sections with their settings; a repeated setting is an error."""
    parser = ConfigParser(interpolation=None, comment_prefixes=("#",), delimiters=("=",))
    parser.optionxform = str  # names keep their case
    parser.read_string(UNIT.read_text(encoding="utf-8"))
    return parser


def grd(*arguments: object, code: int = 0) -> str:
    """Output of `grd ARGUMENTS`, which must end with this exit code. An unexpected exception is raised."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output
