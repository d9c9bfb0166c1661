"""Secrets in settings: a URL may hold a name and a password. What a run stores or shows has them replaced.

Source: ours; RFC 3986, 3.2.1 (user information) and 3.4 (query). More is replaced rather than less: a password may hold
characters that a URL must escape, and often does not.
"""

from __future__ import annotations

import re
from typing import Any, cast

HIDDEN = "***"
_USER = re.compile(r"(?<=://)[^\s'\"]*@")
_QUERY = re.compile(r"(?i)([?&;][^=&;\s]*(?:pass|pwd|token|secret|auth|key|credential)[^=&;\s]*=)[^&;\s'\"]*")


def without_secrets(text: str) -> str:
    """A text with the user information and the secret parameters of its URLs replaced."""
    return _QUERY.sub(rf"\1{HIDDEN}", _USER.sub(f"{HIDDEN}@", text))


def values_without_secrets(value: Any) -> Any:
    """The same for every text in nested values."""
    if isinstance(value, dict):
        return {key: values_without_secrets(item) for key, item in cast("dict[str, Any]", value).items()}
    if isinstance(value, list):
        return [values_without_secrets(item) for item in cast("list[Any]", value)]
    return without_secrets(value) if isinstance(value, str) else value
