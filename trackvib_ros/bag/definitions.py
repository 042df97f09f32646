"""Message definitions and type hashes from the installed interface packages.

ROS installations and wheels carry them as ``<prefix>/share/<package>/msg/<Type>.msg`` and
``.json``; the schema text joins a type with everything it contains, as rosbag2 stores it.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from solver import InputError

_SEPARATOR = "\n" + "=" * 80 + "\nMSG: "
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*")
_PRIMITIVES = frozenset(("bool", "byte", "char", "string", "wstring", "float32", "float64")) | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


def interface_prefixes() -> tuple[Path, ...]:
    """Where interface packages are looked for: ``AMENT_PREFIX_PATH``, then this environment."""
    paths = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    return (*paths, Path(sys.prefix))


def message_definition(type_name: str) -> str:
    """Return the ``ros2msg`` schema text of ``package/msg/Type`` with all its dependencies.

    Raises:
        InputError: the type or one of its dependencies is not installed.
    """
    return _definition(type_name, interface_prefixes())


def type_hash(type_name: str) -> str:
    """Return the REP-2011 hash (``RIHS01_...``) of ``package/msg/Type``.

    Raises:
        InputError: the type is not installed.
    """
    text = _interface_file(type_name, ".json", interface_prefixes())
    for entry in json.loads(text)["type_hashes"]:
        if entry["type_name"] == type_name:
            return str(entry["hash_string"])
    raise InputError(f"message type {type_name}: its installed .json states no hash")


@lru_cache(maxsize=256)
def _definition(type_name: str, prefixes: tuple[Path, ...]) -> str:
    text = _interface_file(type_name, ".msg", prefixes)
    parts = [text]
    seen = {type_name}

    def add(types: Iterable[str]) -> None:
        for name in types:
            if name not in seen:
                seen.add(name)
                body = _interface_file(name, ".msg", prefixes)
                parts.append(f"{_SEPARATOR}{name.replace('/msg/', '/')}\n{body}")
                add(_dependencies(name, body))

    add(_dependencies(type_name, text))
    return "".join(parts)


def _dependencies(type_name: str, text: str) -> list[str]:
    package = type_name.split("/")[0]
    found: set[str] = set()
    for line in text.splitlines():
        match = _FIELD.match(line.split("#")[0])
        if match is None or match[1] in _PRIMITIVES:
            continue
        parts = match[1].split("/")
        found.add(f"{parts[0] if len(parts) > 1 else package}/msg/{parts[-1]}")
    return sorted(found)


def _interface_file(type_name: str, suffix: str, prefixes: tuple[Path, ...]) -> str:
    package, _, name = type_name.partition("/msg/")
    for prefix in prefixes:
        path = prefix / "share" / package / "msg" / f"{name}{suffix}"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(
        f"message type {type_name}: no share/{package}/msg/{name}{suffix} under "
        f"{', '.join(map(str, prefixes))}; install the package that defines it"
    )
