"""The service's files, as systemd itself judges them; the installer's own test boots a machine (make test-service)."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parent.parent / "deploy" / "systemd"
UNIT = DEPLOY / "trotd.service"
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemd-analyze", *map(str, arguments)], capture_output=True, text=True, timeout=60, check=False
    )


def placed(tmp_path: Path, text: str, drop_in: Path | None = None) -> Path:
    """The unit with a program that exists here, and its drop-in."""
    unit = tmp_path / "trotd.service"
    unit.write_text(text.replace("/opt/trotd/current/bin/trotd", shutil.which("true") or "/bin/true"))
    if drop_in is not None:
        folder = tmp_path / "trotd.service.d"
        folder.mkdir()
        shutil.copy(drop_in, folder)
    return unit


@needs_systemd
@pytest.mark.parametrize("drop_in", [None, DEPLOY / "pi3hat.conf"], ids=["plain", "pi3hat"])
def test_the_unit_has_nothing_that_systemd_does_not_know(tmp_path: Path, drop_in: Path | None) -> None:
    unit = placed(tmp_path, UNIT.read_text(), drop_in)
    result = analyze("verify", "--recursive-errors=no", "--man=no", unit)
    assert result.returncode == 0, result.stderr
    assert str(unit) not in result.stderr


@needs_systemd
def test_the_check_would_see_an_unknown_key(tmp_path: Path) -> None:
    unit = placed(tmp_path, UNIT.read_text().replace("[Install]", "MemoryLock=infinity\n\n[Install]"))
    result = analyze("verify", "--recursive-errors=no", "--man=no", unit)
    assert result.returncode != 0 and "MemoryLock" in result.stderr


@needs_systemd
@pytest.mark.parametrize("drop_in", [None, DEPLOY / "pi3hat.conf"], ids=["plain", "pi3hat"])
def test_exposure_is_at_most_four(tmp_path: Path, drop_in: Path | None) -> None:
    result = analyze("security", "--offline=yes", "--threshold=40", placed(tmp_path, UNIT.read_text(), drop_in))
    assert result.returncode == 0, result.stdout[-300:]


def test_nothing_forbids_what_the_daemon_needs() -> None:
    unit = UNIT.read_text()
    assert "RestrictRealtime=yes" not in unit, "sched_setscheduler would fail"
    assert "MemoryDenyWriteExecute=yes" not in unit, "compiled code could not be loaded"
    assert "AF_CAN" in unit and "LimitRTPRIO=" in unit and "LimitMEMLOCK=infinity" in unit
    assert re.search(r"^Type=notify$", unit, re.M) and re.search(r"^WatchdogSec=", unit, re.M)


def test_the_unit_runs_a_command_that_the_front_door_has() -> None:
    from typer.main import get_command

    from trotd.cli import app

    words = re.search(r"^ExecStart=\S+ (.+)$", UNIT.read_text(), re.M)
    assert words is not None
    command, *options = words[1].split()
    run = get_command(app).commands[command]  # type: ignore[attr-defined]
    known = {name for parameter in run.params for name in parameter.opts}
    assert {option for option in options if option.startswith("--")} <= known


@pytest.mark.parametrize("script", ["install.sh", "uninstall.sh"])
def test_scripts_are_posix_shell_and_refuse_to_run_as_nobody(script: str, tmp_path: Path) -> None:
    assert subprocess.run(["sh", "-n", DEPLOY / script], check=False, timeout=10).returncode == 0
    fake = tmp_path / "id"
    fake.write_text("#!/bin/sh\necho 1000\n")
    fake.chmod(0o755)
    result = subprocess.run(
        ["sh", DEPLOY / script],
        env={"PATH": f"{tmp_path}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=10,
        check=False,
    )
    assert result.returncode == 1 and "must be root" in result.stderr


def test_the_installer_copies_only_files_that_exist() -> None:
    for name in re.findall(r'"\$here/([\w.-]+)"', (DEPLOY / "install.sh").read_text()):
        assert (DEPLOY / name).is_file(), name
