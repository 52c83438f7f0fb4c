"""What a result was made from: enough to tell whether two belong together, and to make one again."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version

import msgspec

from runtime.config import Config
from runtime.control.policy import Policy
from runtime.policies import layout_hash

PACKAGES = ("trotd", "numpy", "numba", "daqp", "pybullet", "scipy")


def config_hash(config: Config) -> str:
    """Of everything in a robot's TOML that shapes its motion; which policy it loads does not. 16 hex digits."""
    control = msgspec.structs.replace(config.control, policy="")
    data = msgspec.json.encode((config.robot, control), order="deterministic")
    return hashlib.sha256(data).hexdigest()[:16]


def declared(policy: Policy, config: Config) -> Policy:
    """``policy`` with the rate and the layout that it is trained with: what a robot's door holds it against."""
    return msgspec.structs.replace(policy, rate_hz=config.control.rate_hz, layout=layout_hash(policy.output))


def versions() -> dict[str, str]:
    """Of Python, this machine's architecture and the packages that a result depends on to the bit."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found
