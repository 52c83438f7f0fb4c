"""The pre-flight: every row says ok where all is well, and what is wrong and what to do where it is not."""

from __future__ import annotations

import asyncio
import json
import resource
from pathlib import Path

import msgspec
import numpy as np
import pytest
from bench_robot import Bench, motors_config
from rich.console import Console

from drivers import calibration
from drivers.calibration import VERSION, Calibration, fingerprint
from drivers.survey import build_question, survey
from drivers.wiring import BusConfig, ImuConfig
from drivers.xsens import ImuCounters, ImuIdentity
from runtime import config
from runtime.config import Config
from trotd.check import command, computer, imu, motors
from trotd.check.computer import check_system, check_timing, judge_timing
from trotd.check.imu import check_latency, judge_gravity, judge_health, judge_identity, judge_rate
from trotd.check.motors import check_interfaces, check_motors, judge_bus, judge_joints, judge_motors
from trotd.check.rows import Row, passed, print_json, print_table
from trotd.wire import Wires, calibration_file, own_wires

CONFIG = config.override(config.load(config.find_robot("stoch3")), "test", {"limits.arming_voltage": 20.0})
WANTED = {(1, 11): "FL abduction", (1, 12): "FL hip", (2, 21): "FR abduction"}
STAND = np.array([[0.0, 0.75, -1.4]] * 4)
FIRST = "FL abduction (id 11, bus 1)"


def rows_of(bench: Bench, wanted: dict[tuple[int, int], str] = WANTED) -> dict[str, Row]:
    found = asyncio.run(survey(bench.bus, range(1, 5), build_question(bench.motors.config)))
    return {row.what: row for row in judge_motors(wanted, found, CONFIG.limits)}


# Motors ----------------------------------------------------------------------------------------------------------


def test_a_motor_in_order_tells_mode_voltage_temperature_and_firmware() -> None:
    row = rows_of(Bench())[FIRST]
    assert (row.verdict, row.found) == ("ok", "mode 0: stopped, 24.0 V, 30 °C, firmware 0.1.6")


def test_an_mit_motor_in_order_says_what_it_does_not_tell() -> None:
    bench = Bench(protocol="mit", model="AK80-9", id=((1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12)))
    row = rows_of(bench, {(1, 1): "FL abduction"})["FL abduction (id 1, bus 1)"]
    assert (row.verdict, row.found) == ("ok", "disabled, voltage not told, 30 °C, firmware not told")
    bench.servos[0].fault = 4
    row = rows_of(bench, {(1, 1): "FL abduction"})["FL abduction (id 1, bus 1)"]
    assert row.verdict == "fail"
    assert "under-voltage" in row.found


@pytest.mark.parametrize(
    ("spoil", "verdict", "found", "advice"),
    [
        (lambda s: s.fail(40), "fail", "under-voltage", "switch it off and on"),
        (lambda s: setattr(s, "silent", True), "fail", "no answer", "cable"),
        (lambda s: setattr(s, "voltage", 19.5), "fail", "19.5 V", "arming asks for 20 V"),
        (lambda s: setattr(s, "temperature", 70.0), "fail", "70 °C", "at most 65 °C"),
        (lambda s: setattr(s, "mode", 11), "warn", "watchdog", "daemon's start stops it"),
    ],
)
def test_each_thing_that_can_be_wrong_with_a_motor_has_its_words(spoil, verdict, found, advice) -> None:
    bench = Bench()
    spoil(bench.servos[0])
    row = rows_of(bench)[FIRST]
    assert row.verdict == verdict
    assert found in row.found
    assert advice in row.advice


def test_a_motor_of_other_firmware_is_a_warning() -> None:
    bench = Bench()
    assert "firmware" not in rows_of(bench)
    bench.servos[4].firmware = 0x000105
    row = rows_of(bench)["firmware"]
    assert (row.verdict, row.found) == ("warn", "the motors differ: 0.1.5, 0.1.6")


def test_strangers_doubles_and_wrong_plugs_are_pointed_at() -> None:
    bench = Bench(bus=((2, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4)))
    rows = rows_of(bench)
    assert "answers on bus 2" in rows[FIRST].advice
    assert rows["id 13, bus 1"].verdict == "warn"
    double = Bench()
    double.bus.servos[0, 99] = type(double.servos[0])(11)  # type: ignore[call-arg]
    row = rows_of(double)[FIRST]
    assert (row.verdict, row.found, row.advice) == ("fail", "2 answers to one question", "two motors share this id")


def test_buses_with_errors_are_a_warning() -> None:
    bus = Bench().bus
    assert judge_bus(bus).verdict == "ok"
    for name in ("error_frames", "bus_off", "send_failures"):
        bus = Bench().bus
        setattr(bus.counters, name, 3)
        assert judge_bus(bus).verdict == "warn"
        assert "3 " in judge_bus(bus).found


def test_the_kernels_counters_and_queue_of_a_can_interface(tmp_path: Path) -> None:
    bus = BusConfig(backend="socketcan", channels=("can0", "can1", "can2"))
    for name, errors, queue in (("can0", 0, 1000), ("can1", 7, 1000), ("can2", 0, 10)):
        statistics = tmp_path / "sys/class/net" / name / "statistics"
        statistics.mkdir(parents=True)
        for kind in ("rx_errors", "tx_errors", "rx_dropped"):
            (statistics / kind).write_text(f"{errors}\n")
        (statistics.parent / "tx_queue_len").write_text(f"{queue}\n")
    good, errors, short = check_interfaces(bus, tmp_path)
    assert good.verdict == "ok"
    assert (errors.verdict, "7 tx errors" in errors.found) == ("warn", True)
    assert (short.verdict, "txqueuelen 100" in short.advice) == ("warn", True)
    assert check_interfaces(msgspec.structs.replace(bus, backend="udp_multicast"), tmp_path) == []


def test_a_joint_outside_its_range_is_named_with_the_range() -> None:
    assert [row.verdict for row in judge_joints(CONFIG, STAND)] == ["ok"]
    outside = STAND.copy()
    outside[1, 2], outside[3, 0] = 0.5, np.nan
    knee, unknown = judge_joints(CONFIG, outside)
    assert (knee.what, knee.verdict, knee.found) == ("FR knee", "fail", "at 0.50 rad, range -2.89 to -0.02")
    assert unknown.what == "BR abduction"


def test_a_bus_that_is_missing_is_a_row_and_not_a_crash() -> None:
    wires = Wires(BusConfig(backend="socketcan", channels=("can9",) * 4), motors_config(), ImuConfig())
    rows = asyncio.run(check_motors(CONFIG, wires))
    assert {row.verdict for row in rows} == {"fail"}
    assert "bus 1 (socketcan can9)" in rows[0].found
    few = Wires(BusConfig(backend="virtual", channels=("one",)), motors_config(), ImuConfig())
    (row,) = asyncio.run(check_motors(CONFIG, few))
    assert "motors.bus has bus 4" in row.found


def test_joints_are_read_once_all_motors_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(motors, "build_bus", lambda _bus, _motors: bench.bus)
    wires = Wires(BusConfig(backend="virtual", channels=("a", "b", "c", "d")), motors_config(), ImuConfig())
    assert asyncio.run(check_motors(CONFIG, wires))[-1].found == "all inside their ranges"
    bench.servos[1].position = 0.5  # type: ignore[attr-defined]
    rows = {row.what: row for row in asyncio.run(check_motors(CONFIG, wires))}
    assert rows["FL hip"].found == "at -1.67 rad, range -0.59 to 2.11"
    bench.servos[7].silent = True
    assert asyncio.run(check_motors(CONFIG, wires))[-1].found == "not looked at"
    assert {servo.mode for servo in bench.servos} == {0}


# IMU -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("force", "verdict"),
    [
        ((0.0, 0.0, 9.8), "ok"),
        ((0.5, 0.0, 9.78), "ok"),
        ((0.0, 0.0, 9.52), "ok"),
        ((0.0, 0.0, 10.15), "fail"),
        ((0.0, 0.0, -9.8), "fail"),
        ((0.0, 6.0, 7.75), "warn"),
        ((0.0, 0.0, 8.0), "fail"),
        ((0.0, 0.0, 0.0), "fail"),
        ((0.0, 0.0, np.nan), "fail"),
    ],
)
def test_gravity_must_have_its_size_and_direction(force, verdict) -> None:
    assert judge_gravity(np.array(force)).verdict == verdict


def test_the_imu_says_who_it_is() -> None:
    row = judge_identity(ImuIdentity("MTI-610-8A7G6", "00", "1.8.2", gives_orientation=False))
    assert (row.verdict, "yaw is relative" in row.found) == ("ok", True)
    assert judge_identity(ImuIdentity("MTI-300-2A8G4", "00", "1.8.2", gives_orientation=True)).verdict == "warn"


def test_a_slow_clipped_or_broken_imu_is_told() -> None:
    config_400, counters = ImuConfig(rate_hz=400), ImuCounters()
    assert judge_rate(399.0, config_400, counters).verdict == "ok"
    slow = judge_rate(370.0, config_400, counters)
    assert (slow.verdict, slow.found) == ("warn", "370 Hz of 400, 0 lost")
    assert judge_health(counters) == []
    self_test, clipped = judge_health(ImuCounters(self_test_failed=1, clipped=2))
    assert (self_test.verdict, clipped.verdict) == ("fail", "warn")


def test_a_serial_adapter_that_holds_bytes_back_is_told(tmp_path: Path) -> None:
    setting = tmp_path / "sys/bus/usb-serial/devices/ttyUSB7/latency_timer"
    assert check_latency("/dev/ttyUSB7", tmp_path).verdict == "ok"
    setting.parent.mkdir(parents=True)
    setting.write_text("16\n")
    row = check_latency("/dev/ttyUSB7", tmp_path)
    assert (row.verdict, row.found, "echo 1" in row.advice) == ("warn", "16 ms", True)
    setting.write_text("1\n")
    assert check_latency("/dev/ttyUSB7", tmp_path).verdict == "ok"


def test_an_imu_that_is_not_there_is_a_row() -> None:
    (row,) = asyncio.run(imu.check_imu(ImuConfig(port="/dev/no-such-imu")))
    assert row.verdict == "fail"
    assert "/dev/no-such-imu" in row.found


# The computer ----------------------------------------------------------------------------------------------------


def test_timing_is_judged_by_its_slowest_percent_and_by_missed_ticks() -> None:
    assert judge_timing(200.0, [1e-4] * 100, 0).verdict == "ok"
    assert judge_timing(200.0, [1e-4] * 90 + [2e-3] * 10, 0).verdict == "warn"
    missed = judge_timing(200.0, [1e-4] * 100, 1)
    assert (missed.verdict, "1 overruns" in missed.found) == ("warn", True)
    assert "lateness" in asyncio.run(check_timing(200.0, 0.1)).found


def system(root: Path) -> dict[str, Row]:
    return {row.what: row for row in check_system(root)}


def test_the_governor_and_isolation_are_told(tmp_path: Path) -> None:
    processors = tmp_path / "sys/devices/system/cpu"
    governor = processors / "cpu0/cpufreq/scaling_governor"
    governor.parent.mkdir(parents=True)
    governor.write_text("powersave\n")
    rows = system(tmp_path)
    assert (rows["CPU governor"].verdict, rows["CPU governor"].advice) == ("warn", "performance")
    assert rows["isolated cores"].verdict == "warn"
    governor.write_text("performance\n")
    (processors / "isolated").write_text("3\n")
    rows = system(tmp_path)
    assert (rows["CPU governor"].verdict, rows["isolated cores"].verdict) == ("ok", "ok")
    assert rows["isolated cores"].found == "3"


@pytest.mark.parametrize(("soft", "verdict"), [(0, "warn"), (resource.RLIM_INFINITY, "ok")])
def test_limits_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, soft: int, verdict: str) -> None:
    monkeypatch.setattr(computer.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(computer.resource, "getrlimit", lambda _limit: (soft, soft))
    rows = system(tmp_path)
    assert rows["real-time priority"].verdict == rows["locked memory"].verdict == verdict


@pytest.mark.parametrize(("threads", "verdict"), [("1", "ok"), ("2", "warn"), (None, "warn")])
def test_blas_threads_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, threads, verdict) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        if threads is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, threads)
    assert system(tmp_path)["BLAS threads"].verdict == verdict


# The whole -------------------------------------------------------------------------------------------------------


def calibrated(made: Config, folder: Path) -> None:
    wired = own_wires(made).motors
    table = {"version": VERSION, "robot": made.robot.name, "body": fingerprint(made.robot, wired)}
    table |= {"date": "2026-11-22T12:00:00Z", "mount": [1.0, 0.0, 0.0, 0.0]}
    table |= {name: getattr(wired, name) for name in ("id", "bus", "direction", "offset")}
    calibration.save(msgspec.convert(table, Calibration), calibration_file("hardware", made, folder))


def test_a_calibration_that_is_not_there_fails_and_says_what_to_do(tmp_path: Path) -> None:
    row, wires = command.judge_calibration("hardware", CONFIG, tmp_path, own_wires(CONFIG))
    assert (row.verdict, row.advice) == ("fail", "trotd commission")
    calibrated(CONFIG, tmp_path)
    row, wires = command.judge_calibration("hardware", CONFIG, tmp_path, own_wires(CONFIG))
    assert row.verdict == "ok"
    assert wires.motors.id == own_wires(CONFIG).motors.id


def test_everything_is_in_one_table_whatever_is_missing(tmp_path: Path) -> None:
    made = config.override(CONFIG, "test", {"imu.port": "/dev/no-such-imu"})
    rows = {row.what: row for row in asyncio.run(command.check("hardware", made, tmp_path, soak=0.05))}
    assert {"calibration", "buses", "IMU", "timing at 200 Hz", "BLAS threads", "isolated cores"} <= set(rows)
    assert "moteus-pi3hat" in rows["buses"].found
    assert not passed(list(rows.values()))


def test_the_table_and_its_json_say_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [Row("one", "ok", "fine"), Row("two", "warn", "hm", "look")]
    print_json(rows)
    said = json.loads(capsys.readouterr().out)
    assert said["passed"] is True
    assert said["rows"][1] == {"what": "two", "verdict": "warn", "found": "hm", "advice": "look"}
    print_table(rows, Console(width=80))
    assert "look" in capsys.readouterr().out
    assert not passed([*rows, Row("three", "fail", "gone")])


def test_a_motor_with_an_unknown_id_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.bus.servos[0, 77] = bench.bus.servos.pop((0, 13))
    bench.servos[2].id = 77
    monkeypatch.setattr(motors, "build_bus", lambda _bus, _motors: bench.bus)
    wires = Wires(BusConfig(backend="virtual", channels=("a", "b", "c", "d")), motors_config(), ImuConfig())
    rows = {row.what: row for row in asyncio.run(check_motors(CONFIG, wires))}
    assert rows["FL knee (id 13, bus 1)"].advice == "supply, cable, id? Bus 1 has id 77 that nobody asked for"
    assert rows["id 77, bus 1"].verdict == "warn"
