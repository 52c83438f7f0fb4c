"""``trotd commission`` from end to end: a robot in a process of its own, put together at random, and its wires."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from daemons import free_endpoint
from test_commission import assert_true

from drivers import calibration
from runtime import config
from sim.build import Build, build_of, lab_build, scrambled
from trotd.wire import MEETING, calibration_file, own_wires, twin_folder

PATIENCE = 600.0
"""s, of a computer that does many other things."""
RUNS = 5
"""Runs that may be needed, each going on where the last one ended: a busy computer may keep a motor's replies, or its
twin's time, for longer than any motor may be silent."""
HELD_UP = ("does not answer any more", "did not turn")
"""What a run that ended for that reason says."""
pytestmark = pytest.mark.timeout(1200)


class Shell:
    """Commands about one twin in one state folder."""

    def __init__(self, robot: str, folder: Path) -> None:
        self.config = config.load(config.find_robot(robot))
        self.folder, self.endpoint = folder, free_endpoint()

    def line(self, command: str, *arguments: str) -> list[str]:
        robot = ["--robot", self.config.robot.name, "--state", str(self.folder)]
        return [sys.executable, "-m", "trotd.cli", command, *robot, *arguments]

    def commission(self, *arguments: str, answers: str = "") -> subprocess.CompletedProcess[str]:
        line = self.line("commission", "--body", "twin", "--connect", self.endpoint, *arguments)
        return subprocess.run(line, input=answers, capture_output=True, text=True, timeout=PATIENCE, check=False)

    def check(self) -> tuple[int, dict[str, str]]:
        """Exit code, and the verdicts by row."""
        line = self.line("check", "--body", "twin", "--json")
        done = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE, check=False)
        return done.returncode, {row["what"]: row["verdict"] for row in json.loads(done.stdout)["rows"]}

    @contextlib.contextmanager
    def twin(self, seed: int) -> Iterator[None]:
        line = self.line("twin", "--connect", self.endpoint, "--scramble", str(seed))
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            try:
                end = time.monotonic() + PATIENCE
                while not (twin_folder(self.folder, self.config.robot.name) / MEETING).exists():
                    assert process.poll() is None and time.monotonic() < end, process.communicate()
                    time.sleep(0.1)
                yield
            finally:
                process.terminate()

    def truth(self, seed: int) -> Build:
        wires = own_wires(self.config)
        known = lab_build() if self.config.robot.name == "stoch3" else build_of(wires.motors, wires.imu.mount)
        return scrambled(known, seed)

    def found(self) -> calibration.Calibration:
        wires = own_wires(self.config)
        return calibration.load(calibration_file("twin", self.config, self.folder), self.config.robot, wires.motors)


def test_a_scrambled_robot_is_understood_over_its_wires_even_if_interrupted(tmp_path: Path) -> None:
    shell = Shell("stoch3", tmp_path)
    progress = twin_folder(tmp_path, "stoch3") / "calibration.progress.json"
    with shell.twin(7):
        code, rows = shell.check()
        assert (code, rows["calibration"]) == (1, "fail")
        line = shell.line("commission", "--body", "twin", "--connect", shell.endpoint, "--rehearse")
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as half:
            assert half.stdout is not None
            said = list(iter(half.stdout.readline, "BL knee: let go of all legs\n"))
            half.send_signal(signal.SIGINT)
        assert half.returncode not in (0, None)
        assert "12 motors answer:" in said[0]
        assert len(json.loads(progress.read_bytes())["joints"]) >= 8
        rest = shell.commission("--rehearse")
        assert rest.returncode == 0, rest.stderr
        assert "FL abduction: turn" not in rest.stdout
        assert "BL knee: turn" in rest.stdout
        assert_true(shell.found(), shell.truth(7))
        once_more = shell.commission("--rehearse", "--undo", "mount")
        assert once_more.returncode == 0, once_more.stderr
        assert once_more.stdout.count("IMU: hold") == 3
        assert_true(shell.found(), shell.truth(7))
        for _ in range(5):
            _, rows = shell.check()
            if rows["IMU"] == "ok":  # a busy computer may keep its bytes for longer than is waited for the first ones
                break
        assert rows["calibration"] == "ok"
        assert {verdict for what, verdict in rows.items() if " (id " in what} == {"ok"}
        assert rows["joints"] == rows["IMU"] == rows["gravity"] == "ok"


def test_mit_motors_wiggle_and_are_understood_over_their_wires(tmp_path: Path) -> None:
    shell = Shell("mini_cheetah", tmp_path)
    with shell.twin(3):
        for _ in range(RUNS):
            done = shell.commission("--rehearse", "--wiggle", "--jig", "0,0.9,-1.8")
            if done.returncode == 0:
                break
            assert any(words in done.stderr for words in HELD_UP), done.stderr
        assert done.returncode == 0, done.stderr
        assert_true(shell.found(), shell.truth(3), zero=0.02)
        _, rows = shell.check()
        assert {verdict for what, verdict in rows.items() if " (id " in what} == {"ok"}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--undo", "everything"], 2, "--undo everything: joints, zeros, mount or baseline"),
        (["--jig", "straight"], 2, "--jig straight: abduction,hip,knee in rad"),
        (["--jig", "0,9,0"], 2, "within ±3.2 rad"),
        ([], 1, "no twin of 'stoch3'"),
        (["--baseline"], 1, "run trotd commission"),
        (["--undo", "baseline"], 1, "run trotd commission"),
    ],
)
def test_what_makes_no_sense_is_one_line(tmp_path: Path, arguments: list[str], code: int, words: str) -> None:
    done = Shell("stoch3", tmp_path).commission(*arguments)
    assert done.returncode == code
    (line,) = done.stderr.strip().splitlines()
    assert words in line


def test_hands_are_for_the_twin_alone(tmp_path: Path) -> None:
    shell = Shell("stoch3", tmp_path)
    done = subprocess.run(shell.line("commission", "--rehearse"), capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--rehearse has hands for --body twin only" in done.stderr


def test_truths_of_two_seeds_differ(tmp_path: Path) -> None:
    shell = Shell("mini_cheetah", tmp_path)
    assert not np.array_equal(shell.truth(3).direction, shell.truth(4).direction)
