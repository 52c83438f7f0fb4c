"""From outside the service's machine: walk it, wait for it in damp, look at what it kept (tests/service.sh)."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import msgspec

from runtime import config, policies
from runtime.control.policy import encode_policy
from runtime.messages.mode import Mode, ModeReply, Request
from runtime.messages.recording import RecordingEntry
from runtime.recording import load
from runtime.replay import replay
from station.push import active, known, send
from station.session import Station, StationError, connected

DEADLINE = 60.0


def ask(station: Station, wish: Request) -> None:
    reply = station.ask_for(ModeReply, station.keys.mode, wish.value.encode())
    if not reply.accepted:
        raise StationError(f"{wish.value}: {reply.reason}")


def walk(station: Station) -> None:
    """Two seconds forward, and still walking at the end."""
    ask(station, Request.ARM)
    ask(station, Request.STAND)
    end = time.monotonic() + DEADLINE
    while station.next_status().mode != "STAND":
        if time.monotonic() > end:
            raise StationError("does not stand up")
    reply = send(station, candidate())
    if not reply.accepted:
        raise StationError(f"policy: {reply.reason}")
    ask(station, Request.WALK)
    end = time.monotonic() + DEADLINE
    count = 0
    while count < 100 or not proven(station):  # a policy is kept for the next start once it has walked
        if time.monotonic() > end:
            raise StationError("the policy is not kept")
        for _ in range(20):
            station.session.put(station.keys.velocity, json.dumps({"linear": [0.4, 0.0], "yaw_rate": 0.0}))
            time.sleep(0.02)
            count += 1
    status = station.next_status()
    if status.mode != "WALK":
        raise StationError(f"{status.mode}: {status.reason}")
    print(f"walks at {status.velocity[0]:.2f} m/s under {status.policy}")


def candidate() -> bytes:
    """A policy of another name than the shipped one."""
    policy = policies.load(policies.find_policy(config.load(config.find_robot("stoch3")).control.policy), "stoch3")
    return encode_policy(msgspec.structs.replace(policy, name="candidate"))


def proven(station: Station) -> bool:
    return any(entry.role == "kept" and entry.name == "candidate" for entry in known(station))


def recovered(station: Station) -> None:
    """The last good policy is active, and the recording of the run that was killed is whole to its last tick."""
    name, _ = active(station)
    if name.name != "candidate":
        raise StationError(f"policy {name.name} is active")
    entries = station.ask_for(list[RecordingEntry], station.keys.recording)
    crashed = [entry for entry in entries if entry.name.endswith("-crash.trotd")]
    if not crashed:
        raise StationError("no recording of the crash")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / crashed[-1].name
        path.write_bytes(station.ask(station.keys.recording, parameters=f"name={path.name}", timeout=60.0))
        recording = load(path)
        result = replay(recording)
    if recording.ticks["mode"][-1] != Mode.WALK or result.difference is not None:
        raise StationError(f"{path.name}: ends in mode {recording.ticks['mode'][-1]}; {result.difference}")
    print(f"{path.name}: {len(recording.ticks)} ticks up to the walk's last, bit for bit the same in replay")


def damped(_station: Station) -> None:
    """In damp, and without a fault."""
    status = _station.next_status()
    if status.mode != "DAMP" or status.fault:
        raise StationError(f"{status.mode}: {status.fault}")


def main() -> int:
    act = {"walk": walk, "damped": damped, "recovered": recovered}[sys.argv[-1]]
    end = time.monotonic() + DEADLINE
    while True:
        try:
            with connected("stoch3") as station:
                act(station)
                return 0
        except StationError as error:
            if act is walk or time.monotonic() > end:
                print(error, file=sys.stderr)
                return 1
            time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
