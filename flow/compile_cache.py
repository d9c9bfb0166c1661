"""The folder in which compiled code is cached: its name depends on the source of all compiled functions.

Numba checks only a function's own file to detect a stale cache, not the files of the functions that are compiled into
it. A folder name that depends on every file makes numba compile everything again when any of them changes.

Source: ours; Numba manual, "Notes on Caching".
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def cache_name(folders: Iterable[Path]) -> str:
    """A name that depends on the content of every Python file in these folders and below them."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{path.relative_to(folder).as_posix()}\n".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def cache_folder(name: str) -> Path:
    """The folder for this name in $NUMBA_CACHE_DIR, the user's cache, or a temporary folder of this process."""
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    folder = Path(wanted) if wanted else user / "grd"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a service without a home, a full or read-only disk
        folder = Path(tempfile.mkdtemp(prefix="grd-"))  # random: others could prepare a folder of known name
    return folder / name


def folder_of(folders: Iterable[str]) -> Path:
    """The cache folder for the source of `folders`, relative to the project's root."""
    return cache_folder(cache_name(ROOT / name for name in folders))
