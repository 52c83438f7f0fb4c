"""``trotd ros2``."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Annotated

import typer

from trotd.cli_station import ENDPOINT, ConnectOption, RobotOption
from trotd.exits import one_line_errors

if TYPE_CHECKING:
    from station.ros2 import Bridge

ROUTER = "tcp/127.0.0.1:7448"


def register(app: typer.Typer) -> None:
    """Put the command beside those of the front door."""
    app.command()(ros2)


def ros2(
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    router: Annotated[
        str, typer.Option(help="ROS 2's zenoh router that runs: this command connects to it, and listens nowhere.")
    ] = ROUTER,
    domain: Annotated[int | None, typer.Option(min=0, max=232, help="Domain id; ROS_DOMAIN_ID or 0 if none.")] = None,
    namespace: Annotated[str, typer.Option(help="Of the node and its topics; /tf is everybody's.")] = "/",
    hz: Annotated[float, typer.Option(min=1.0, max=1000.0, help="Messages a second on each topic at most.")] = 50.0,
    observe: Annotated[bool, typer.Option("--observe", help="Take no /cmd_vel.")] = False,
    seconds: Annotated[float, typer.Option(help="Stop after this time; 0 for never.")] = 0.0,
) -> None:
    """Be a ROS 2 node for the robot, among nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp (Jazzy or later).

    Publishes /joint_states, /imu/data, /odom and /tf. /cmd_vel (Twist or TwistStamped) steers a robot that already
    walks: `trotd arm`, `trotd stand`, `trotd walk` come first. It is cut to the robot's bounds; when it stops coming,
    the robot stops after 0.2 s and stands after 2 s.

    ROS 2's router and the daemon both come up on port 7447, so one of them has to move. The router:
    `ZENOH_CONFIG_OVERRIDE='listen/endpoints=["tcp/127.0.0.1:7448"]' ros2 run rmw_zenoh_cpp rmw_zenohd`

    Or the daemon, beside a router that runs already: `trotd run --listen tcp/127.0.0.1:7449`, then
    `trotd ros2 --connect tcp/127.0.0.1:7449 --router tcp/127.0.0.1:7447`
    """
    from rich.console import Console
    from rich.live import Live

    from runtime import config
    from station.ros2 import Bridge, open_router
    from station.session import connected

    end = time.monotonic() + seconds if seconds > 0 else float("inf")
    with one_line_errors():
        number = int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain is None else domain
        known = config.load(config.find_robot(robot))
        with connected(known.robot.name, connect) as station, open_router(router) as ros:
            bridge = Bridge(station, ros, number, known.control.bounds, namespace, observe)
            with Live(console=Console(stderr=True), refresh_per_second=4, transient=True) as live:
                bridge.run(hz, lambda: time.monotonic() < end, lambda b: live.update(describe(b)))
            typer.echo(describe(bridge), err=True)


def describe(bridge: Bridge) -> str:
    """What went out and what came in, in one line."""
    counts = ", ".join(f"{words} {count}" for words, count in bridge.steering.counts.items() if count)
    return f"{bridge.published} ticks published; /cmd_vel: {counts or 'nothing'}"
