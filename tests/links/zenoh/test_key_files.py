"""A private key that other users can read starts no session."""

from __future__ import annotations

import pytest

from flow.link import LinkError
from links.zenoh.connection import check_ready
from links.zenoh.session_settings import SessionSettings

pytest.importorskip("zenoh", reason="needs Eclipse Zenoh: pip install -e '.[hosts]'")


@pytest.mark.parametrize(("mode", "accepted"), [(0o600, True), (0o400, True), (0o640, False), (0o644, False)])
def test_the_mode_of_the_key_decides(tmp_path, mode, accepted):
    files = {name: tmp_path / f"{name}.pem" for name in ("certificate", "key", "authority")}
    for file in files.values():
        file.write_text("PEM")
        file.chmod(0o644)
    files["key"].chmod(mode)
    settings = SessionSettings(host="vehicle", hub="vehicle", endpoint="tls/127.0.0.1:7447", **files)
    if accepted:
        check_ready(settings)
    else:
        with pytest.raises(LinkError, match=r"other users can read this key\. Restrict it: chmod 600"):
            check_ready(settings)
