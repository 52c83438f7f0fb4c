"""How ROS 2 names things on zenoh: the key expressions, liveliness tokens and attachments of ``rmw_zenoh_cpp``.

Layout after its design document and source (ROS 2 Iron and later, where a type has a hash; Jazzy is the oldest that is
served with this form of the attachment). Nothing here opens a session.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum

import xxhash

ADMIN_SPACE = "@ros2_lv"
DEFAULT_DEPTH = 42
"""Of ``rmw_zenoh_cpp``: what a token leaves out."""
GID_SIZE = 16
_attachment = struct.Struct(f"<qqB{GID_SIZE}s")


class Role(StrEnum):
    """What an entity is, in a token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"


class Reliability(StrEnum):
    """Of a topic; the default is left out of a token."""

    RELIABLE = ""
    BEST_EFFORT = "2"


@dataclass(frozen=True, slots=True)
class Node:
    """One node in the graph."""

    domain: int
    session: str
    """The zenoh session's id."""
    name: str
    namespace: str = "/"
    number: int = 0
    """Of this node within its session."""

    @property
    def token(self) -> str:
        """Its liveliness token."""
        return "/".join((self._session, str(self.number), str(self.number), Role.NODE, self._place))

    @property
    def _session(self) -> str:
        return f"{ADMIN_SPACE}/{self.domain}/{self.session}"

    @property
    def _place(self) -> str:
        """Enclave, namespace and name."""
        return "/".join(("%", mangled(self.namespace), mangled(self.name)))

    def token_of(self, number: int, role: Role, topic: Topic) -> str:
        """Of a publisher or subscription of this node."""
        place = "/".join((self._session, str(self.number), str(number), role, self._place))
        return f"{place}/{mangled(topic.name)}/{dds_name(topic.kind)}/{topic.type_hash}/{topic.quality}"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic with its type."""

    name: str
    """With its leading slash."""
    kind: str
    """``package/msg/Name``."""
    type_hash: str
    """``RIHS01_…``."""
    depth: int = 10
    reliability: Reliability = Reliability.RELIABLE

    @property
    def quality(self) -> str:
        """Quality of service as a token says it: what is the default is left out."""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{self.reliability}::,{depth}:,:,:,,"

    def key(self, domain: int) -> str:
        """Where its messages go."""
        return f"{domain}/{self.name.strip('/')}/{dds_name(self.kind)}/{self.type_hash}"

    def any_hash(self, domain: int) -> str:
        """The same, whatever the publisher's version says of the type's hash."""
        return f"{domain}/{self.name.strip('/')}/{dds_name(self.kind)}/*"


def mangled(name: str) -> str:
    """A name as one chunk of a key expression."""
    return name.replace("/", "%")


def dds_name(kind: str) -> str:
    """``sensor_msgs/msg/Imu`` as ``sensor_msgs::msg::dds_::Imu_``."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def gid_of(token: str) -> bytes:
    """The entity's 16 bytes: the low and the high half of XXH3's 128 bits over its token, each little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_SIZE, "little")


@dataclass(frozen=True, slots=True)
class Attachment:
    """What goes with every message."""

    sequence: int
    """Counted from 1."""
    stamp: int
    """When it was sent, ns since 1970."""
    gid: bytes

    def encode(self) -> bytes:
        """33 bytes."""
        return _attachment.pack(self.sequence, self.stamp, len(self.gid), self.gid)


def decode_attachment(data: bytes) -> Attachment:
    """What a publisher attached.

    Raises:
        ValueError: not of this form.
    """
    if len(data) != _attachment.size or data[16] != GID_SIZE:
        raise ValueError(f"attachment of {len(data)} bytes; rmw_zenoh's has {_attachment.size}")
    sequence, stamp, _, gid = _attachment.unpack(data)
    return Attachment(sequence, stamp, gid)
