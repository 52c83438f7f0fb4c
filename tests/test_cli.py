"""The front door as a shell sees it: exit codes, one-line errors, and a daemon that ends cleanly."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from daemons import free_endpoint

from runtime.messages.mode import ModeReply

ROBOT = Path(__file__).parents[1] / "runtime" / "robots" / "stoch3.toml"


def trotd(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "trotd.cli", *arguments], capture_output=True, text=True, timeout=120, check=False
    )


def changed(folder: Path, old: str, new: str) -> str:
    text = ROBOT.read_text()
    assert old in text
    path = folder / "mine.toml"
    path.write_text(text.replace(old, new, 1))
    return str(path)


def one_line(result: subprocess.CompletedProcess[str]) -> str:
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rate_hz = 200.0", "rate_hz = 2.0", "control.rate_hz = 2.0: Expected `float` >= 50"),
        ("swing_time", "swing_tim", "swing_tim"),
        ("[control.gait]", "[control.gait", "not TOML"),
        ('policy = "trot.json"', 'policy = "nothing.json"', "policy 'nothing.json': no such file"),
        ('name = "stoch3"', 'name = "other"', "this robot is 'other'"),
        ('solver = "daqp"', 'solver = "magic"', "magic"),
    ],
)
def test_bad_input_is_one_line_and_code_2(tmp_path: Path, old: str, new: str, words: str) -> None:
    robot = changed(tmp_path, old, new)
    result = trotd("run", "--body", "null", "--robot", robot, "--listen", free_endpoint(), "--state", str(tmp_path))
    assert result.returncode == 2, result.stderr
    assert words in one_line(result)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--body", "ghost"], "there are sim"),
        (["run", "--robot", "spot"], "stoch3"),
        (["run", "--body", "null", "--rate-hz", "9999"], "command line: control.rate_hz = 9999"),
        (["run", "--body", "null", "--listen", "tcp/0.0.0.0:0"], "off the loopback"),
    ],
)
def test_bad_arguments_are_one_line_and_code_2(tmp_path: Path, arguments: list[str], words: str) -> None:
    result = trotd(*arguments, "--state", str(tmp_path))
    assert result.returncode == 2, result.stderr
    assert words in one_line(result)


def test_nobody_to_talk_to_is_code_1() -> None:
    result = trotd("arm", "--connect", free_endpoint())
    assert result.returncode == 1
    assert "no daemon to talk to at" in one_line(result)


def test_help_teaches() -> None:
    text = trotd("--help").stdout
    for word in ("tour", "run", "status", "arm", "stand", "walk", "sit", "damp", "clear", "command/velocity"):
        assert word in text


def test_a_daemon_serves_the_verbs_and_ends_cleanly(tmp_path: Path) -> None:
    robot = changed(tmp_path, 'name = "stoch3"', 'name = "cli-test"')
    policy = tmp_path / "policy.json"
    shipped = ROBOT.parents[1] / "policies" / "balance.json"
    policy.write_text(shipped.read_text().replace('"robot": "stoch3"', '"robot": "cli-test"'))
    endpoint = free_endpoint()
    run = ["run", "--body", "null", "--robot", robot, "--policy", str(policy), "--state", str(tmp_path)]
    with subprocess.Popen(
        [sys.executable, "-m", "trotd.cli", *run, "--listen", endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as daemon:
        try:
            talk = ["--robot", robot, "--connect", endpoint]
            end = time.monotonic() + 250
            while (answer := trotd("stand", *talk)).returncode and "refused" not in answer.stdout:
                assert daemon.poll() is None and time.monotonic() < end, answer.stderr
                time.sleep(0.2)
            assert answer.returncode == 1
            assert answer.stdout == "refused in DAMP: not armed: ask for arm first\n"
            while (armed := trotd("arm", *talk)).returncode:
                assert "timing" in armed.stdout and time.monotonic() < end, armed.stdout
                time.sleep(0.5)
            *lines, last = armed.stdout.splitlines()
            assert last == "DAMP: armed" and all(line.startswith("ok ") for line in lines)
            assert {"motors", "imu", "calibration", "operator", "timing"} <= {line.split()[1] for line in lines}
            again = msgspec.json.decode(trotd("arm", "--json", *talk).stdout.encode(), type=ModeReply)
            assert [check.name for check in again.checks] == [line.split()[1] for line in lines]
            assert '"armed": true' in trotd("status", *talk).stdout
            second = trotd(*run, "--listen", free_endpoint())
            assert second.returncode == 2
            assert f"served by process {daemon.pid} already" in one_line(second)
            other = trotd("run", "--body", "null", "--listen", endpoint, "--state", str(tmp_path / "other"))
            assert other.returncode == 2
            assert other.stderr.splitlines()[-1] == f"trotd: link endpoint {endpoint!r}: address already in use"
            daemon.send_signal(signal.SIGTERM)
            output, _ = daemon.communicate(timeout=120)
        finally:
            daemon.kill()
    assert daemon.returncode == 0
    recording = Path(output.strip().removeprefix("recording: "))
    assert recording.is_file() and recording.name.endswith("-stop.trotd")
