"""Roles over mutual TLS: each role does what it is for, and a client that tries anything else changes nothing."""

from __future__ import annotations

import asyncio
import json
import stat
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from daemons import Served, free_endpoint, make_config

from runtime import config
from runtime.access import Role, common_name
from runtime.control.policy import encode_policy
from runtime.link import LinkError
from station.keys import add_bearer, make_authority
from station.push import known as known_policies
from station.session import NoAnswer, Station, StationError, connected
from station.tuning import change, known

Try = Callable[[Station], Any]
SILENCE = 1.0
"""s after which nobody will answer any more."""


@pytest.fixture(scope="module")
def bearers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    authority, other = tmp_path_factory.mktemp("keys"), tmp_path_factory.mktemp("others")
    make_authority(authority)
    make_authority(other)
    found = {role.value: add_bearer(authority, role, "one") for role in Role}
    found["foreign"] = add_bearer(other, Role.OPERATOR, "one")
    found["expired"] = add_bearer(authority, Role.OPERATOR, "past", now=datetime.now(UTC) - timedelta(days=1000))
    found["foreign robot"] = add_bearer(other, Role.ROBOT, "one")
    return found


def serve(
    bearers: dict[str, Path],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    bearer: str,
    attempt: Try,
    robot: str = "robot",
) -> tuple[Any, Served]:
    """What ``attempt`` gets as ``bearer`` from a standing robot that listens on TLS alone."""

    async def play() -> tuple[Any, Served]:
        endpoint = free_endpoint().replace("tcp/", "tls/")
        made = make_config(link__listen=[endpoint], link__certificates=str(bearers[robot]))
        async with Served(made, folder) as served:
            await served.stand()
            monkeypatch.setenv("TROTD_CERTIFICATES", str(bearers[bearer]))
            return await served.client(attempt), served

    return asyncio.run(play())


def see(station: Station) -> str:
    assert station.ask(station.keys.tick_schema)
    return station.next_status().mode


def drive(station: Station, timeout: float | None = None) -> bool:
    return json.loads(station.ask(station.keys.mode, b"walk", timeout=timeout))["accepted"]


def teach(station: Station) -> str:
    policy = json.loads(station.ask(station.keys.policy))
    policy["name"] = "taught"
    reply = station.ask(station.keys.policy, json.dumps(policy).encode())
    return json.loads(reply)["name"]


@pytest.mark.parametrize("role", [Role.VIEWER, Role.OPERATOR, Role.TRAINER])
def test_every_role_sees(bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: Role) -> None:
    assert serve(bearers, tmp_path, monkeypatch, role.value, see)[0] == "STAND"


def test_an_operator_drives(bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def attempt(station: Station) -> bool:
        station.session.put(station.keys.velocity, json.dumps({"linear": [0.5, 0.0], "yaw_rate": 0.0}))
        return drive(station)

    answer, served = serve(bearers, tmp_path, monkeypatch, "operator", attempt)
    assert answer is True
    assert any("STAND -> WALK" in event.text for event in served.daemon.link.history)


def test_a_trainer_teaches(bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answer, served = serve(bearers, tmp_path, monkeypatch, "trainer", teach)
    assert answer == "taught" and served.daemon.cycle.policy.name == "taught"


@pytest.mark.parametrize("role", [Role.VIEWER, Role.TRAINER])
def test_who_may_not_drive_gets_silence_and_moves_nothing(
    bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: Role
) -> None:
    def attempt(station: Station) -> None:
        see(station)
        station.session.put(station.keys.velocity, json.dumps({"linear": [0.5, 0.0], "yaw_rate": 0.0}))
        with pytest.raises(NoAnswer, match="may not ask"):
            drive(station, SILENCE)

    _, served = serve(bearers, tmp_path, monkeypatch, role.value, attempt)
    events = [event.text for event in served.daemon.link.history]
    assert not any("WALK" in text or "refused" in text for text in events)
    assert not served.daemon.cycle.sources.velocity.linear.any()


def test_an_operator_sets_and_leans(bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def attempt(station: Station) -> bool:
        station.session.put(station.keys.pose, b'{"roll": 0.5, "pitch": 0, "yaw": 0, "height": 0}')
        return change(station, "swing_height", "0.1").accepted

    answer, served = serve(bearers, tmp_path, monkeypatch, "operator", attempt)
    assert answer is True
    wanted = {entry.name: entry.wanted for entry in served.daemon.list_tuning()}
    assert wanted["swing_height"] == 0.1 and wanted["roll"] == 0.15


@pytest.mark.parametrize("role", [Role.VIEWER, Role.TRAINER])
def test_who_may_not_set_sees_what_could_be_and_changes_nothing(
    bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: Role
) -> None:
    def attempt(station: Station) -> None:
        assert known(station) and known_policies(station)
        station.session.put(station.keys.pose, b'{"roll": 0.5, "pitch": 0, "yaw": 0, "height": 0}')
        with pytest.raises(NoAnswer, match="may not ask"):
            station.ask(station.keys.change_tuning, b'{"name": "swing_height", "value": 0.1}', timeout=SILENCE)

    _, served = serve(bearers, tmp_path, monkeypatch, role.value, attempt)
    assert all(entry.wanted == entry.own for entry in served.daemon.list_tuning())


@pytest.mark.parametrize("role", [Role.VIEWER, Role.OPERATOR])
def test_who_may_not_teach_gets_silence_and_the_policy_stays(
    bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: Role
) -> None:
    def attempt(station: Station) -> None:
        see(station)
        with pytest.raises(NoAnswer):
            station.ask(station.keys.policy, encode_policy(served_policy(station)), timeout=SILENCE)

    def served_policy(station: Station) -> Any:
        from daemons import make_policy

        return make_policy(station.robot)

    _, served = serve(bearers, tmp_path, monkeypatch, role.value, attempt)
    assert served.daemon.cycle.generation == 1


@pytest.mark.parametrize("bearer", ["foreign", "expired"])
def test_a_foreign_or_expired_certificate_does_not_get_in(
    bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bearer: str
) -> None:
    with pytest.raises(StationError):
        serve(bearers, tmp_path, monkeypatch, bearer, see)


def test_an_operator_does_not_talk_to_a_robot_of_a_foreign_authority(
    bearers: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StationError, match="no daemon to talk to"):
        serve(bearers, tmp_path, monkeypatch, "operator", see, robot="foreign robot")


def test_without_a_certificate_the_client_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TROTD_CERTIFICATES", str(tmp_path))
    with pytest.raises(StationError, match=r"ca\.pem: No such file"), connected("stoch3", "tls/127.0.0.1:1"):
        pass


def test_a_daemon_without_its_certificates_does_not_start(tmp_path: Path) -> None:
    async def play() -> None:
        endpoint = free_endpoint().replace("tcp/", "tls/")
        async with Served(make_config(link__listen=[endpoint], link__certificates=str(tmp_path)), tmp_path):
            pass

    with pytest.raises(LinkError, match=r"link.certificates: .*ca.pem: No such file"):
        asyncio.run(play())


@pytest.mark.parametrize(
    ("listen", "certificates"),
    [("tcp/0.0.0.0:7447", ""), ("tls/0.0.0.0:7447", ""), ("tcp/0.0.0.0:7447", "/etc/trotd/certificates")],
)
def test_off_loopback_only_mutual_tls_is_accepted(listen: str, certificates: str) -> None:
    with pytest.raises(config.ConfigError, match="off the loopback interface"):
        make_config(link__listen=[listen], link__certificates=certificates)
    make_config(link__listen=["tls/0.0.0.0:7447"], link__certificates="/etc/trotd/certificates")


def test_certificates_bear_their_role_and_keys_are_their_owner_s_alone(bearers: dict[str, Path]) -> None:
    for role in Role:
        certificate = x509.load_pem_x509_certificate((bearers[role.value] / "cert.pem").read_bytes())
        names = {attribute.value for attribute in certificate.subject}
        assert common_name(role) in names and "one" in names
        assert stat.S_IMODE((bearers[role.value] / "key.pem").stat().st_mode) == 0o600


def test_nothing_that_exists_is_overwritten(tmp_path: Path) -> None:
    make_authority(tmp_path)
    with pytest.raises(StationError, match="exists"):
        make_authority(tmp_path)
    add_bearer(tmp_path, Role.VIEWER, "ann")
    with pytest.raises(StationError, match="exists"):
        add_bearer(tmp_path, Role.VIEWER, "ann")
    for name in ("", "../up", "a b", "x" * 65):
        with pytest.raises(StationError, match="name"):
            add_bearer(tmp_path, Role.VIEWER, name)
