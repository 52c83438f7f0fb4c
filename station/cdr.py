"""Messages under the standard's names as CDR and back, and their type hashes: rosbags' definitions of ROS 2 Jazzy."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore


class CdrError(ValueError):
    """Bytes that are not a message of that type: the message names the type."""


@cache
def _store() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@cache
def type_hash(kind: str) -> str:
    """``RIHS01_…`` of ``package/msg/Name``."""
    return _store().hash_rihs01(kind)


def encode(kind: str, message: Mapping[str, Any]) -> bytes:
    """A message, given as a dictionary of all its fields, as little-endian CDR with its encapsulation header."""
    return bytes(_store().serialize_cdr(_build(kind, message), kind))


def decode(kind: str, data: bytes) -> Any:
    """A message with its fields as attributes.

    Raises:
        CdrError: cut short, too long, or with another encapsulation.
    """
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise CdrError(f"{kind}: {len(data)} bytes without the header of plain CDR")
    try:
        return _store().deserialize_cdr(data, kind)
    except Exception as error:  # the generated reader raises whatever struct, numpy or an assertion do
        raise CdrError(f"{kind}: {len(data)} bytes that are none: {type(error).__name__}") from error


def _build(kind: str, message: Mapping[str, Any]) -> Any:
    fields = _store().fielddefs[kind][1]
    return _store().types[kind](**{name: _value(described, message[name]) for name, described in fields})


def _value(described: Any, value: Any) -> Any:
    node, inner = described
    if node == Nodetype.NAME:
        return _build(inner, value)
    if node == Nodetype.BASE:
        return value
    item = inner[0]
    if item[0] == Nodetype.BASE and item[1][0] != "string":
        return np.array(value, item[1][0])
    return [_value(item, part) for part in value]
