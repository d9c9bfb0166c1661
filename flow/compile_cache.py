"""Where numba keeps compiled code: in a folder named after the source of all of it.

Numba looks at a function's own file to tell whether what it kept is stale, not at the files of the functions it calls,
whose code is compiled in. With the name made of every file, all is compiled anew when any of them changes.

Source: ours; Numba manual, "Notes on Caching".
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from numba.core import config

ROOT = Path(__file__).resolve().parents[1]


def cache_name(folders: Iterable[Path]) -> str:
    """A name that changes with any Python file in these folders and below them, by content."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{path.relative_to(folder).as_posix()}\n".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def cache_folder(name: str) -> Path:
    """Where code of this name is kept: $NUMBA_CACHE_DIR, the user's cache, or a temporary folder of this process."""
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    folder = Path(wanted) if wanted else user / "grd"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a service without a home, a full or read-only disk
        folder = Path(tempfile.mkdtemp(prefix="grd-"))  # of this process: a known name could be prepared by others
    return folder / name


def keep_compiled(folders: Iterable[str]) -> Path:
    """From now on numba keeps what it compiles where the source of these folders (from the project's root) says."""
    folder = cache_folder(cache_name(ROOT / name for name in folders))
    config.CACHE_DIR = str(folder)  # pyright: ignore
    return folder
