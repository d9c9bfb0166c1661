"""A typed `njit`: hot loops compile once, are cached on disk and release the GIL.

Numba looks at a function's own file to tell whether what it kept is stale, not at the files of the functions it calls,
whose code is compiled in. So the cache lies in a folder named after the source of all of them: when any file changes,
everything is compiled anew.

Source: ours; numba's decorator has no types, this one keeps the function's own. Numba manual, "Notes on Caching".
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config

F = TypeVar("F", bound=Callable[..., Any])

STAGES = Path(__file__).parent
COMPILED = (STAGES, STAGES.parent / "links" / "velodyne", STAGES.parent / "links" / "simulated")  # where such code is


def cache_name(folders: Iterable[Path]) -> str:
    """A name that changes with any Python file in these folders and below them, by content."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{path.relative_to(folder).as_posix()}\n".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Where compiled code is kept: $NUMBA_CACHE_DIR, else the user's cache, else a temporary folder of this process."""
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    folder = Path(wanted) if wanted else user / "grd"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a service without a home, a full or read-only disk
        folder = Path(tempfile.mkdtemp(prefix="grd-"))  # of this process: a known name could be prepared by others
    return folder / cache_name(COMPILED)


def compiled(function: F) -> F:
    """`numba.njit(cache=True, nogil=True)`: IEEE arithmetic, so that two machines agree."""
    return cast(F, numba.njit(cache=True, nogil=True)(function))  # pyright: ignore


CACHE_FOLDER = cache_folder()
config.CACHE_DIR = str(CACHE_FOLDER)  # pyright: ignore
