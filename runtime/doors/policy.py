"""The door of policies: what is active, a candidate's verdict, a rollback's."""

from __future__ import annotations

from concurrent.futures import Future

import msgspec
import zenoh

from runtime import policies
from runtime.audition import Outcome
from runtime.config import Config
from runtime.doors.answers import Doors
from runtime.doors.crossing import Crossing, read_query
from runtime.messages.policy import PolicyReply
from runtime.shelf import PolicyFile


class PolicyDoor:
    """``policy`` of one robot."""

    def __init__(self, config: Config, key: str, crossing: Crossing, doors: Doors) -> None:
        self._config, self._key, self._crossing, self._doors = config, key, crossing, doors

    def answer(self, query: zenoh.Query) -> None:
        """What is active, at once; what became of a candidate, when it is known: nobody else waits for that."""
        data, rollback = read_query(query, policies.LARGEST_FILE + 1), "rollback" in query.parameters
        try:
            if not data and not rollback:
                with query:
                    query.reply(self._key, self._crossing.ask(self._doors.active_policy).data)
                return
            file = None if rollback else self._verified(data)
            immediate = "immediate" in query.parameters
            self._crossing.ask(lambda: self._offer(file, immediate, query))
        except policies.PolicyError as error:
            outcome = Outcome(False, str(error), {})
            self._crossing.ask(lambda: self._reply(query, outcome))
        except Exception as error:
            with query:
                query.reply_err(str(error).encode())

    def _verified(self, data: bytes) -> PolicyFile:
        policy = policies.decode(data, self._config.robot.name, "candidate")
        policies.check_manifest(
            policy, self._config.control.rate_hz, self._config.audition.max_norm, f"candidate {policy.name}"
        )
        return PolicyFile(policy, data)

    def _offer(self, file: PolicyFile | None, immediate: bool, query: zenoh.Query) -> None:
        """On the loop: hand the candidate over, or roll back; the answer leaves from the loop too, when it is known."""
        done: Future[Outcome] = Future()
        if file is None:
            self._doors.roll_back(done)
        else:
            self._doors.offer_policy(file, immediate, done)
        done.add_done_callback(lambda settled: self._reply(query, settled.result()))

    def _reply(self, query: zenoh.Query, outcome: Outcome) -> None:
        if not outcome.accepted:
            self._crossing.refuse(self._key, outcome.words)
        active = self._doors.active_policy()
        reply = PolicyReply(outcome.accepted, active.policy.name, active.sha256, outcome.words, outcome.report)
        with query:
            query.reply(self._key, msgspec.json.encode(reply))
