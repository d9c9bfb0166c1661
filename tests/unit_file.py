"""Reads deploy/grd.service."""

from __future__ import annotations

from configparser import ConfigParser
from pathlib import Path

UNIT = Path(__file__).resolve().parents[1] / "deploy" / "grd.service"


def unit_file() -> ConfigParser:
    """Sections with their settings; a repeated setting is an error."""
    parser = ConfigParser(interpolation=None, comment_prefixes=("#",), delimiters=("=",))
    parser.optionxform = str  # names keep their case
    parser.read_string(UNIT.read_text(encoding="utf-8"))
    return parser
