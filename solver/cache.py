"""Results that are computed once and kept on disk: stored atomically, bounded in size."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import fields
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import platformdirs

CACHE_BYTES = 2 * 2**30

Result = TypeVar("Result")


def cached(key: Mapping[str, Any], kind: type[Result], compute: Callable[[], Result]) -> Result:
    """A dataclass of arrays and numbers, from disk if it was computed before.

    Args:
        key: all that the result depends on but the version of the program, fit for JSON.
        kind: the dataclass.
        compute: called if nothing is stored.
    """
    text = json.dumps({**key, "version": _version()}, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:32]
    place = Path(platformdirs.user_cache_dir("trackvib", appauthor=False))
    path = place / f"line-{digest}.npz"
    found = _read(path, kind)
    if found is None:
        found = compute()
        _write(path, found)
    return found


def _version() -> str:
    try:
        return metadata.version("trackvib")
    except metadata.PackageNotFoundError:
        return "source"


def _read(path: Path, kind: type[Result]) -> Result | None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            values = {field.name: stored[field.name] for field in fields(kind)}  # type: ignore[arg-type]
        os.utime(path)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
    return kind(**{name: v if v.ndim else v.item() for name, v in values.items()})


def _write(path: Path, result: object) -> None:
    """A cache that cannot be written is skipped."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **{f.name: getattr(result, f.name) for f in fields(result)})  # type: ignore[arg-type]
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        stored = sorted(path.parent.glob("line-*.npz"), key=lambda p: p.stat().st_mtime)
        total = sum(p.stat().st_size for p in stored)
        for old in stored[:-1]:
            if total <= CACHE_BYTES:
                break
            total -= old.stat().st_size
            old.unlink()
