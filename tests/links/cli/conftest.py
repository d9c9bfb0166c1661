"""Commands of grd in an empty folder."""

from __future__ import annotations

import pytest

from tests import command


@pytest.fixture
def grd(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return command.grd
