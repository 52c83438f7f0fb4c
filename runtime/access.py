"""Who may do what over zenoh: mutual TLS, and rules by the role that a certificate bears as its common name.

A folder of certificates holds ``ca.pem``, ``cert.pem`` and ``key.pem``; ``trotd keys`` makes them. Everything that no
rule allows is denied, and zenoh says nothing to those it denies. Plain TCP on the loopback interface is this machine's
own and may do everything.
"""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Any

import zenoh

from runtime.messages.keys import Keys


class Role(StrEnum):
    """What a certificate is for."""

    ROBOT = "robot"
    """The daemon itself."""
    VIEWER = "viewer"
    """Sees everything, changes nothing."""
    OPERATOR = "operator"
    """A viewer who drives."""
    TRAINER = "trainer"
    """A viewer who sends policies."""


CA, CERTIFICATE, KEY = "ca.pem", "cert.pem", "key.pem"
_LISTENING = ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"]
_ANY = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
]


class AccessError(ValueError):
    """A folder of certificates that cannot be used: the message names the file."""


def common_name(role: Role) -> str:
    """What a certificate of this role calls its bearer."""
    return f"trotd-{role.value}"


def check_folder(folder: Path) -> None:
    """Whether all three files are there and can be read.

    Raises:
        AccessError: naming the first that is not.
    """
    for name in (CA, CERTIFICATE, KEY):
        try:
            (folder / name).read_bytes()
        except OSError as error:
            raise AccessError(f"{folder / name}: {error.strerror}; trotd keys makes it") from error


def use_certificates(config: zenoh.Config, folder: Path) -> None:
    """Prove who we are, and believe only who proves it with the same authority.

    Raises:
        AccessError: a file is missing or unreadable.
    """
    check_folder(folder)
    certificate, key = str(folder / CERTIFICATE), str(folder / KEY)
    settings = {
        "root_ca_certificate": str(folder / CA),
        "enable_mtls": True,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    for name, value in settings.items():
        config.insert_json5(f"transport/link/tls/{name}", json.dumps(value))


def control_access(config: zenoh.Config, robot: str) -> None:
    """Let each role do what it is for, and nobody else anything."""
    config.insert_json5("access_control", json.dumps(rules(robot)))


def rules(robot: str) -> dict[str, Any]:
    """zenoh's ``access_control`` for the daemon of ``robot``."""
    keys = Keys(robot)
    everything = f"{keys.root}/**"
    seeing = [
        _rule("see", _LISTENING, [everything]),
        _rule(
            "ask",
            ["query"],
            [keys.tick_schema, keys.event, keys.recording, keys.policies, keys.tuning, keys.faults],
        ),
    ]
    driving = [
        _rule("steer", ["put"], [keys.velocity, keys.pose]),
        _rule("change-mode", ["query"], [keys.mode, keys.change_tuning]),
        _rule("hold-token", ["liveliness_token"], [f"{keys.operator}/*"]),
    ]
    teaching = [_rule("send-policy", ["query"], [keys.policy])]
    tell = {**_rule("tell", _ANY, [everything]), "flows": ["egress"]}
    hear = _rule("hear", _ANY, ["**"])
    own = {**_rule("own", _ANY, ["**"]), "flows": ["ingress", "egress"]}
    allowed = {
        Role.VIEWER: seeing,
        Role.OPERATOR: seeing + driving,
        Role.TRAINER: seeing + teaching,
        Role.ROBOT: [hear],
    }
    local = {"id": "local", "interfaces": ["lo"], "link_protocols": ["tcp"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*seeing, *driving, *teaching, tell, hear, own],
        "subjects": [*({"id": role.value, "cert_common_names": [common_name(role)]} for role in Role), local],
        "policies": [
            {"rules": ["own"], "subjects": ["local"]},
            *(
                {"rules": [rule["id"] for rule in granted] + ["tell"], "subjects": [role.value]}
                for role, granted in allowed.items()
            ),
        ],
    }


def _rule(name: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": ["ingress"], "messages": messages, "key_exprs": keys}
