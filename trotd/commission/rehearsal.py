"""A person for ``trotd commission`` on the wire twin: does with the twin's body what is asked, and says what it sees.

It talks to the simulated world alone, as hands and eyes do: nothing here knows an id, a sign, a zero or how the IMU is
mounted.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import zenoh

from drivers.errors import DriverError
from drivers.robot import JOINTS, LEGS, Array
from runtime.config import Config
from runtime.link import session_config
from runtime.messages.keys import Keys
from runtime.messages.simulation import SimHold, SimTruth
from trotd.commission.steps import Task

TILT = 0.5
"""rad that the body is tilted by."""
TURN = 0.35
"""rad that a joint is turned by."""
MEETING_TIME, HANDS_TIME = 60.0, 60.0
"""s that the twin may take to be met, and to be where the hands hold it, on a computer that does much else."""
CLOSE = 0.03
"""rad."""
STILL, REST, HANGING_TIME = 0.01, 30, 120.0
"""Legs that were let go hang still when no joint turns by more than this, rad, in so many messages of the twin, which
it sends by its own time; waited for at most, s."""
_RPY = ((0.0, 0.0, 0.0), (0.0, TILT, 0.0), (-TILT, 0.0, 0.0))


class Rehearsal:
    """One pair of hands and eyes on one twin; called with a task, it returns the answer."""

    def __init__(self, config: Config, session: zenoh.Session, say: Callable[[str], None]) -> None:
        joints, keys = config.robot.joints, Keys(config.robot.name)
        self._say = say
        self._lower, self._upper = np.array(joints.lower), np.array(joints.upper)
        self._joints = np.clip(np.zeros((4, 3)), self._lower + 0.1, self._upper - 0.4)
        self._session, self._key = session, keys.sim_hold
        self._seen = session.declare_subscriber(keys.sim_truth, zenoh.handlers.RingChannel(2000))
        self._before = self._joints

    def __call__(self, task: Task) -> str:
        """Do it."""
        self._say(task.words)
        answer = {
            "turn": self._turn,
            "stop": self._stop,
            "jig": self._fit,
            "tilt": self._tilt,
            "watch": self._let_go,
            "say": self._answer,
            "let go": self._stay,
        }[task.act](task)
        if answer:
            self._say(f"  {answer}")
        return answer

    def meet(self) -> None:
        """Wait until the twin is seen.

        Raises:
            DriverError: it is not.
        """
        self._look(MEETING_TIME)

    def set_down(self) -> None:
        """Put the robot back on the ground."""
        self._session.put(self._key, msgspec.json.encode(SimHold((0.0, 0.0, 0.0), down=True)))

    def _turn(self, task: Task) -> str:
        self._joints[task.leg, task.joint] += TURN
        self._hold(self._joints)
        return ""

    def _stop(self, task: Task) -> str:
        ends = (self._lower, self._upper)[task.index]
        self._joints[task.leg, task.joint] = ends[task.leg, task.joint]
        self._hold(self._joints)
        return ""

    def _stay(self, _task: Task) -> str:
        self._hold(self._joints)
        return ""

    def _fit(self, task: Task) -> str:
        self._joints[:] = task.angles
        self._hold(self._joints)
        return ""

    def _tilt(self, task: Task) -> str:
        self._hold(self._joints, _RPY[task.index])
        return ""

    def _let_go(self, _task: Task) -> str:
        """And wait until the legs hang still."""
        self._hold(None)
        end = time.monotonic() + HANGING_TIME
        while time.monotonic() < end:
            before = _joints_of(self._look())
            self._before = _joints_of(self._look(count=REST))
            if np.abs(self._before - before).max() < STILL:
                break
        return ""

    def _answer(self, _task: Task) -> str:
        """The joint that turned furthest since the legs were let go; of those that swung along, the first."""
        turned = max((_joints_of(seen) - self._before for seen in self._watched()), key=lambda way: np.abs(way).max())
        moved = np.abs(turned) > 0.5 * np.abs(turned).max()
        leg, joint = (int(index[0]) for index in np.nonzero(moved))
        return f"{LEGS[leg]} {JOINTS[joint]} {'+' if turned[leg, joint] > 0 else '-'}"

    def _hold(self, joints: Array | None, rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Hold the body so, and return when it is seen to be."""
        hold = SimHold(rpy, () if joints is None else tuple(joints.ravel().tolist()))
        end = time.monotonic() + HANDS_TIME
        while time.monotonic() < end:
            self._session.put(self._key, msgspec.json.encode(hold))
            time.sleep(0.05)
            seen = self._look()
            there = joints is None or np.abs(_joints_of(seen) - joints).max() < CLOSE
            if there and np.abs(np.subtract(seen.rpy, rpy)).max() < CLOSE:
                return
        raise DriverError("the twin does not follow the hands that hold it: does it still run?")

    def _look(self, seconds: float = HANDS_TIME, count: int = 1) -> SimTruth:
        """The twin as it is now, or ``count`` messages later."""
        self._watched()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if seen := self._watched():
                count -= len(seen)
                if count <= 0:
                    return seen[-1]
            time.sleep(0.005)
        raise DriverError("nothing is seen of the twin: does trotd twin run, with the same --connect?")

    def _watched(self) -> list[SimTruth]:
        """All that was seen since the last look, oldest first."""
        seen = []
        while (sample := self._seen.try_recv()) is not None:
            seen.append(msgspec.json.decode(sample.payload.to_bytes(), type=SimTruth))
        return seen


def _joints_of(seen: SimTruth) -> Array:
    return np.array(seen.joints).reshape(4, 3)


@contextlib.contextmanager
def rehearsal(config: Config, endpoint: str, say: Callable[[str], None]) -> Iterator[Rehearsal]:
    """Hands and eyes at ``endpoint``, where the twin looks for its daemon.

    Raises:
        DriverError: the twin is not there, or a daemon is in the way.
    """
    zenoh.init_log_from_env_or("off")
    try:
        session = zenoh.open(session_config("peer", [endpoint], []))
    except zenoh.ZError as error:
        raise DriverError(f"{endpoint}: somebody listens there already; stop the daemon first ({error})") from error
    with session:
        hands = Rehearsal(config, session, say)
        hands.meet()
        yield hands
        hands.set_down()
        time.sleep(0.2)  # so that the last message leaves
