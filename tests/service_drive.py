"""From outside the service's machine: walk it, or wait until it is back in damp (tests/service.sh)."""

from __future__ import annotations

import json
import sys
import time

from runtime.messages import ModeReply, Request
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
    ask(station, Request.WALK)
    for _ in range(100):
        station.session.put(station.keys.velocity, json.dumps({"linear": [0.4, 0.0], "yaw_rate": 0.0}))
        time.sleep(0.02)
    status = station.next_status()
    if status.mode != "WALK":
        raise StationError(f"{status.mode}: {status.reason}")
    print(f"walks at {status.velocity[0]:.2f} m/s")


def damped(_station: Station) -> None:
    """In damp, and without a fault."""
    status = _station.next_status()
    if status.mode != "DAMP" or status.fault:
        raise StationError(f"{status.mode}: {status.fault}")


def main() -> int:
    act = {"walk": walk, "damped": damped}[sys.argv[-1]]
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
