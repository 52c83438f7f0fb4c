"""A candidate on its way to be the active policy: in shadow, at support, on trial; and back when it does no good.

Everything happens in the loop's slack, after a tick's command was computed: ``step`` looks at the finished tick and
prepares the next one. A candidate first runs beside the active policy on the same measurements. It takes over only on
four feet or where the gait hands over from one set of legs to the next, its share growing over the blend; while it is
on trial, a rise of tilt, of the height's error, of the clamps or of the failed solutions gives the share back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from runtime.control.controller import alike
from runtime.control.policy import policy_record
from runtime.control.records import CONTROL_DTYPE
from runtime.control.shadow import SUMS_DTYPE, shadow
from runtime.control.state import STATE_DTYPE
from runtime.cycle import Cycle
from runtime.messages.mode import Mode
from runtime.parameters import AuditionConfig
from runtime.policies import PolicyError
from runtime.proving import Baseline, Watch, describe, object_to_shadow, read_shadow
from runtime.shelf import PolicyFile, Shelf

_RUNNING = (int(Mode.STAND), int(Mode.WALK))


class Stage(Enum):
    """Where the candidate is."""

    SHADOW = "in shadow"
    SUPPORT = "waiting for support"
    TRIAL = "on trial"
    STOOD = "proved while standing, to be watched in its first walk"
    RETURN = "on the way back"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a candidate."""

    accepted: bool
    words: str
    report: dict[str, float]
    """What the shadow found; empty without one."""


Answer = Callable[[Outcome], None]


class Audition:
    """The one door through which policies change while the daemon runs."""

    def __init__(self, cycle: Cycle, shelf: Shelf, config: AuditionConfig) -> None:
        self.stage: Stage | None = None
        self._cycle, self._shelf, self._config = cycle, shelf, config
        self._dt = 1.0 / cycle.config.control.rate_hz
        self._policies = policy_record(cycle.policy)
        self._states, self._records = np.zeros(1, STATE_DTYPE), np.zeros(1, CONTROL_DTYPE)
        self._sums = np.zeros(1, SUMS_DTYPE)
        self._seconds = 0.0
        """In this stage, while a policy ran."""
        self._walked = 0.0
        self._share_step = 0.0
        self._stance = np.zeros(4)
        self._baseline = Baseline()
        self._candidate: PolicyFile
        self._good: PolicyFile
        self._report: dict[str, float] = {}
        self._answer: Answer | None = None
        self._immediate = self._rolling_back = False

    def warm_up(self) -> None:
        """Compile the shadow."""
        self._listen()
        self._sums[:] = 0

    def _blocked(self, over_trial: bool) -> bool:
        """Whether another policy has to wait; one on trial that nobody waits for may be followed by the next."""
        if self.stage is Stage.TRIAL:
            return not over_trial or self._answer is not None
        return self.stage in (Stage.SHADOW, Stage.SUPPORT, Stage.RETURN)

    def offer(self, candidate: PolicyFile, immediate: bool, answer: Answer) -> None:
        """Take in a candidate whose file was verified; ``answer`` is called once, on the loop.

        Args:
            candidate: the policy and its bytes.
            immediate: no shadow, and an answer as soon as it is active; for simulated bodies.
            answer: gets the outcome.

        Raises:
            PolicyError: not now.
        """
        mode = self._cycle.state.mode
        if self._blocked(immediate or mode is Mode.DAMP):
            assert self.stage is not None
            raise PolicyError(f"policy {self._candidate.policy.name} is {self.stage.value}: push again in a moment")
        if self._cycle.controller.share < 1.0:
            raise PolicyError("the last policy is still being blended in: push again in a moment")
        if mode in (Mode.STAND_UP, Mode.SIT_DOWN):
            raise PolicyError("still moving: push again when it stands, walks or lies")
        if mode is Mode.WALK and not alike(self._cycle.policy, candidate.policy):
            raise PolicyError("it differs in reading or output from the active policy: only while standing")
        if candidate.sha256 == self._shelf.active.sha256:
            answer(Outcome(True, "already active", {}))
            return
        if self.stage is None:
            self._good = self._shelf.active
        self._candidate, self._answer, self._report = candidate, answer, {}
        self._immediate, self._rolling_back = immediate, False
        self._baseline = Baseline()
        if mode is Mode.DAMP:
            self._activate(1.0)
            self._reply(True, f"active, not proved: kept once it has walked for {self._config.trial:g} s")
        elif immediate:
            self._enter(Stage.SUPPORT)
        else:
            self._policies[:] = policy_record(candidate.policy)
            self._states[:], self._sums[:] = 0, 0
            self._states["shifts"] = self._cycle.controller.state["shifts"][:1]
            self._enter(Stage.SHADOW)
            self._cycle.note("policy", f"{candidate.policy.name}: in shadow for {self._config.shadow:g} s")

    def roll_back(self, answer: Answer) -> None:
        """Return to the last good policy; one on trial is given up at once.

        Raises:
            PolicyError: there is none to return to, or not now.
        """
        if self.stage in (Stage.TRIAL, Stage.STOOD):
            self._go_back("rolled back")
            answer(Outcome(True, "rolled back", {}))
            return
        good = self._shelf.last_good()
        if good is None:
            raise PolicyError("no policy was active before this one")
        if self._blocked(False) or self._cycle.state.mode in (Mode.STAND_UP, Mode.SIT_DOWN):
            raise PolicyError("not now: a policy is being changed, or the robot stands up or sits down")
        self._shelf.disapprove(self._shelf.active)
        self._candidate, self._answer, self._report, self._rolling_back = good, answer, {}, True
        if self._cycle.state.mode is Mode.DAMP:
            self._take_over()
        else:
            self._enter(Stage.SUPPORT)

    def stop(self) -> None:
        """The daemon ends: whoever waits is told."""
        self._reply(False, "the daemon is stopping")

    def step(self) -> None:
        """After a tick: look at it, and prepare the next one. Only while ``stage`` is not None."""
        row = self._cycle.tick[0]
        running = int(row["mode"]) in _RUNNING
        match self.stage:
            case Stage.SHADOW | Stage.SUPPORT if not running:
                self._refuse("the robot no longer stands or walks: push again")
            case Stage.SHADOW:
                self._listen()
                self._seconds += self._dt
                if self._seconds >= self._config.shadow - 1e-9:
                    self._judge_shadow(int(row["mode"]))
            case Stage.SUPPORT:
                self._seconds += self._dt
                if self._supported(row):
                    self._take_over()
                elif self._seconds > self._config.wait:
                    self._refuse(f"no support by all legs, nor a change of legs, within {self._config.wait:g} s")
            case Stage.RETURN:
                if not running or self._blend() >= 1.0:
                    self._cycle.share_policy(1.0)
                    self.stage = None
            case Stage.TRIAL | Stage.STOOD:
                self._watch(row, running)

    # Stages ------------------------------------------------------------------------------------------------------

    def _enter(self, stage: Stage) -> None:
        self.stage, self._seconds = stage, 0.0

    def _listen(self) -> None:
        controller = self._cycle.controller
        shadow(
            controller.parameters,
            self._policies,
            self._states,
            self._records,
            controller.state,
            controller.record,
            self._config.tilt_ahead,
            self._sums,
        )

    def _judge_shadow(self, mode: int) -> None:
        """What it would have done is told; what would have been no good is refused."""
        total = self._sums[0]
        self._baseline, self._report = read_shadow(total, mode)
        comparable = alike(self._cycle.policy, self._candidate.policy) and self._candidate.policy.output == "wrench"
        objection = object_to_shadow(total, self._report, comparable, self._config)
        if objection:
            self._refuse(objection)
            return
        self._cycle.note("policy", f"{self._candidate.policy.name}: {describe(self._report)}")
        self._enter(Stage.SUPPORT)
        self._stance[:] = self._cycle.tick["stance"][0]

    def _supported(self, row: np.void) -> bool:
        """On four feet, or in the tick in which the legs change: a swing begins where another one has ended."""
        stance = row["stance"]
        changed = self._seconds > 1.5 * self._dt and bool((stance != self._stance).any()) and int(stance.sum()) >= 2
        self._stance[:] = stance
        return bool(stance.all()) or changed

    def _take_over(self) -> None:
        running = self._cycle.state.mode is not Mode.DAMP
        self._activate(0.0 if running else 1.0)
        self._share_step = self._dt / self._config.blend
        if self._immediate:
            self._reply(True, "active, on trial")
        elif self._rolling_back:  # it proved good before
            self._prove("rolled back")
            self.stage = Stage.RETURN if running else None

    def _activate(self, share: float) -> None:
        self._shelf.activate(self._candidate, share)
        self._enter(Stage.TRIAL)
        self._walked = 0.0
        self._trial = Watch(self._baseline, self._config, self._dt)

    def _blend(self) -> float:
        """Move the share on by one tick; returns it."""
        share = self._cycle.controller.share
        if share < 1.0:
            share = min(1.0, share + self._share_step)
            self._cycle.share_policy(share)
        return share

    # Trial -------------------------------------------------------------------------------------------------------

    def _watch(self, row: np.void, running: bool) -> None:
        if not running:
            self._interrupted()
            return
        self._blend()
        walking = int(row["mode"]) == int(Mode.WALK)
        self._seconds += self._dt
        self._walked += self._dt if walking else 0.0
        trouble = self._trial.trouble(row, walking, self._seconds)
        if trouble:
            self._go_back(trouble)
        elif self._walked >= self._config.trial:
            self._prove("proved")
            self.stage = None
        elif self.stage is Stage.TRIAL and self._seconds >= self._config.trial and not walking:
            self.stage = Stage.STOOD
            self._cycle.note("policy", f"{self._candidate.policy.name}: proved while standing")
            self._reply(
                True, f"proved while standing; kept for the next start once it has walked for {self._config.trial:g} s"
            )

    def _interrupted(self) -> None:
        """The robot does not run a policy now: by a fault, that is the candidate's; else the trial waits."""
        state = self._cycle.state
        if self._seconds > 0.0 and state.reason.is_fault:
            self._go_back(f"the robot damped: {state.reason.words}")
        else:
            self._reply(True, "active, not proved: the robot was stopped during the trial")

    def _prove(self, words: str) -> None:
        candidate, answer, report = self._candidate, self._answer, self._report
        self._answer = None
        self._shelf.approve(candidate)
        self._cycle.note("policy", f"{candidate.policy.name}: {words}")

        def kept(problem: str) -> None:
            if problem:
                self._cycle.note("policy", f"{candidate.policy.name}: {problem}")
            if answer is not None:
                answer(Outcome(True, f"{words}, {problem or 'kept'}", report))

        self._shelf.keep(candidate, kept)

    def _go_back(self, why: str) -> None:
        """Give the share back to the policy before, from where it is."""
        bad, good = self._candidate, self._good
        self._cycle.note("policy", f"{bad.policy.name}: back to {good.policy.name}: {why}")
        self._reply(False, why)
        share = 1.0 - self._cycle.controller.share
        running = int(self._cycle.tick["mode"][0]) in _RUNNING
        self._shelf.activate(good, share if running else 1.0)
        self._share_step = self._dt / self._config.return_time
        self.stage = Stage.RETURN if running else None

    def _refuse(self, why: str) -> None:
        self._cycle.note("policy", f"{self._candidate.policy.name}: refused: {why}")
        self.stage = None
        self._reply(False, why)

    def _reply(self, accepted: bool, words: str) -> None:
        answer, self._answer = self._answer, None
        if answer is not None:
            answer(Outcome(accepted, words, self._report))
