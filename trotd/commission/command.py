"""``trotd commission`` from the shell's side: which steps, whose hands, and where the calibration goes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import typer

from drivers import calibration
from drivers.calibration import Calibration, CalibrationError
from drivers.survey import FoundMotor
from runtime.config import Config
from station.session import connected
from trotd.commission.baseline import carried_over, find_baseline, listen, with_baseline
from trotd.commission.rehearsal import rehearsal
from trotd.commission.steps import STEPS, Commission, Task
from trotd.commission.wires import CommissionWires
from trotd.wire import calibration_file, own_wires, wires_of

BASELINE = "baseline"


@dataclass(frozen=True, slots=True)
class Choices:
    """What the command line said."""

    body: str
    wiggle: bool = False
    jig: str | None = None
    undo: str | None = None
    anew: bool = False
    rehearse: bool = False
    connect: str = ""


def commission(config: Config, folder: Path, choices: Choices, say: Callable[[str], None]) -> None:
    """Do what is left of the steps and write the calibration.

    Raises:
        DriverError: a step did not give an answer to trust; what was found until then is kept.
        ValueError: choices that make no sense.
    """
    jig = None if choices.jig is None else _jig(choices.jig)
    if choices.undo is not None and choices.undo not in (*STEPS, BASELINE):
        raise ValueError(f"--undo {choices.undo}: {', '.join(STEPS)} or {BASELINE}")
    if choices.rehearse and choices.body != "twin":
        raise ValueError(f"--rehearse has hands for --body twin only, not for {choices.body}")
    path = calibration_file(choices.body, config, folder)
    if choices.undo == BASELINE:
        known = _known(path, config)
        calibration.save(with_baseline(known, (0.0, 0.0, 0.0, 0.0)), path)
        say(f"calibration without baseline: {path}")
        return
    wires = wires_of(choices.body, config, folder)
    progress = path.with_suffix(".progress.json")
    if choices.anew:
        progress.unlink(missing_ok=True)
    with CommissionWires(wires) as readings, _hands(config, choices, say) as ask:
        work = Commission(config, wires.motors, progress, readings, ask, wiggle=choices.wiggle, jig=jig)
        if choices.undo is not None:
            work.undo(choices.undo)  # type: ignore[arg-type]
        if work.complete:
            say(f"everything was found already ({progress}): --undo a step, or --anew")
        else:
            say(_listed(readings.scan()))
        found = work.run()
    with contextlib.suppress(CalibrationError):
        found = carried_over(_known(path, config), found)
    calibration.save(found, path)
    say(f"calibration: {path}")
    if not any(found.contact_baseline):
        say("left to do, with the robot standing under its daemon: trotd commission --baseline")


def listen_to_legs(config: Config, folder: Path, choices: Choices, say: Callable[[str], None]) -> None:
    """Find the baseline of a robot that stands under its daemon, and add it to its calibration.

    Raises:
        DriverError: no calibration yet, it does not stand, or a leg feigns too much.
        StationError: no daemon.
    """
    path = calibration_file(choices.body, config, folder)
    known = _known(path, config)
    with connected(config.robot.name, choices.connect) as station:
        baseline = find_baseline(config, listen(station))
    calibration.save(with_baseline(known, baseline), path)
    say(f"the legs feign {', '.join(f'{force:+.1f}' for force in baseline)} N (FL FR BL BR)")
    say(f"calibration: {path}; the next start of the daemon uses it")


def _known(path: Path, config: Config) -> Calibration:
    return calibration.load(path, config.robot, own_wires(config).motors)


def _jig(text: str) -> tuple[float, float, float]:
    try:
        abduction, hip, knee = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ValueError(f"--jig {text}: abduction,hip,knee in rad, such as 0,0.9,-1.8") from error
    if not all(abs(angle) <= 3.2 for angle in (abduction, hip, knee)):
        raise ValueError(f"--jig {text}: angles within ±3.2 rad")
    return abduction, hip, knee


@contextlib.contextmanager
def _hands(config: Config, choices: Choices, say: Callable[[str], None]) -> Iterator[Callable[[Task], str]]:
    if choices.rehearse:
        with rehearsal(config, choices.connect, say) as hands:
            yield hands
    else:
        yield _person


def _person(task: Task) -> str:
    """Ask whoever sits at the terminal."""
    words = task.words if task.act == "say" else f"{task.words}; then Enter"
    answer: str = typer.prompt(words, default="", show_default=False)
    return answer


def _listed(found: list[FoundMotor]) -> str:
    rows = (f"  bus {motor.bus} id {motor.id}: {motor.state}" for motor in found)
    return "\n".join([f"{len(found)} motors answer:", *rows])
