"""How the core is compiled: ``@compiled`` is numba's njit with a disk cache that notices every change.

Numba's cache looks at the file of a function, not at those of the functions it calls: after an upgrade that touched
only an inner room the robot would go on running the old one. So the cache lives in a folder named after the digest of
all sources that are ever compiled.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numba

_ROOT = Path(__file__).parents[2]


def source_digest(package: str) -> str:
    """Digest of every source file that compiled code of ``package`` may call: its own room's and those below."""
    below = {"guard": ("runtime",), "sim": ("sim",), "training": ("sim", "training")}.get(package, ())
    digest = hashlib.sha256()
    for room in ("drivers", "runtime/control", *below):
        for path in sorted((_ROOT / room).glob("*.py")):
            text = path.read_bytes()
            if room != "runtime" or b"@compiled" in text:
                digest.update(path.name.encode())
                digest.update(text)
    return digest.hexdigest()[:16]


def package_of(module: str) -> str:
    """The package that a module's compiled code belongs to: the runtime outside its core is ``guard``."""
    package = module.partition(".")[0]
    return "guard" if package == "runtime" and not module.startswith("runtime.control.") else package


@lru_cache
def cache_folder(package: str) -> Path:
    """Where compiled code is kept: ``NUMBA_CACHE_DIR``, the service's cache, or the user's; else a temporary folder."""
    named = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("CACHE_DIRECTORY")
    base = Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "trotd"
    folder = base / f"compiled-{source_digest(package)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="trotd-compiled-"))


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call, or load it from the cache. Divisions by zero give inf, as in numpy."""
    numba.config.CACHE_DIR = str(cache_folder(package_of(function.__module__)))  # type: ignore[attr-defined]
    return cast(Callable[..., Any], numba.njit(cache=True, error_model="numpy")(function))
