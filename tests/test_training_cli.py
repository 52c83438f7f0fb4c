from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from daemons import free_endpoint, running
from typer.testing import CliRunner

from runtime import config, policies
from station.push import active
from trotd.cli import app

RUN = ["--iterations", "1", "--directions", "1", "--ticks", "40", "--no-validate", "--workers", "1"]
STAGES = 6
"""Of a run from zero: so many iterations are played where each has one."""


def call(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "tried"
    code, output = call("train", "--out", str(folder), "--name", "tried", *RUN)
    assert code == 0, output
    return folder


def test_a_run_leaves_all_that_is_needed_to_make_it_again(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert names >= {"run.json", "versions.json", "curve.jsonl", "reference.npz", "checkpoints", "tried.json"}
    assert len((finished / "curve.jsonl").read_text().splitlines()) == STAGES
    policy = policies.load(finished / "tried.json", "stoch3")
    assert policy.provenance["run"] == json.loads((finished / "run.json").read_text())
    assert policy.provenance["versions"]["numpy"] == np.__version__


def test_a_finished_run_resumes_to_the_same_policy(finished: Path) -> None:
    before = (finished / "tried.json").read_bytes()
    code, output = call("train", "--resume", str(finished), "--no-validate", "--workers", "1")
    assert code == 0, output
    assert (finished / "tried.json").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--resume", "/nonexistent/run"], "no run here"),
        (["--variant", "cubic"], "cubic|enum"),
        (["--robot", "no-such-robot"], "no-such-robot"),
        (["--start", "no-such-policy"], "no-such-policy"),
        (["--reference", "/nonexistent/d.npz"], "No such file"),
        (["--start", "trot", "--variant", "mlp"], "'trot' is no mlp"),
        (["--start", "trot", "--variant", "linear-grf"], "no linear-grf"),
        (["--rough"], "--start"),
    ],
)
def test_bad_input_is_one_line_and_a_code(arguments: list[str], message: str, tmp_path: Path) -> None:
    target = [] if "--resume" in arguments else ["--out", str(tmp_path / "run")]
    code, output = call("train", *arguments, *target, *RUN)
    assert code in (1, 2)
    assert output.count("trotd: ") == 1
    assert any(part in output for part in message.split("|"))
    assert not (tmp_path / "run").exists()


def test_a_folder_that_holds_a_run_is_left_alone(finished: Path) -> None:
    code, output = call("train", "--out", str(finished), *RUN)
    assert code == 2 and "--resume" in output


def test_policies_are_shown_and_compared(finished: Path) -> None:
    code, output = call("policy", "show", "balance")
    assert code == 0 and "force_z" in output
    code, output = call("policy", "diff", "balance", str(finished / "tried.json"))
    assert code == 0 and "balance → tried" in output
    code, output = call("policy", "show", "no-such")
    assert code == 2 and "no-such" in output


def test_the_table_is_json_for_machines() -> None:
    arguments = ["evaluate", "balance", "--quick", "--only", "forward 2.0", "--json", "--workers", "1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["results"]["forward 2.0 m/s"]["balance"]["of"] == 1


def test_every_iteration_is_pushed_to_the_running_robot(tmp_path: Path) -> None:
    with running(tmp_path / "state", config.find_robot("stoch3"), "sim") as (process, station):
        before = active(station)[1]
        arguments = list(process.args)  # type: ignore[call-overload]
        endpoint = arguments[arguments.index("--listen") + 1]
        folder = tmp_path / "run"
        code, output = call("train", "--out", str(folder), "--name", "live", "--push", "--connect", endpoint, *RUN)
        assert code == 0, output
        policy, digest = active(station)
        last = (folder / "checkpoints" / f"{STAGES:04d}.json").read_bytes()
    assert output.count("s  pushed") == STAGES
    assert digest == hashlib.sha256(last).hexdigest() != before
    assert policy.name == "live"


def test_nobody_to_push_to_is_one_line(tmp_path: Path) -> None:
    code, output = call("train", "--out", str(tmp_path / "run"), "--push", "--connect", free_endpoint(), *RUN)
    assert code == 1
    assert output.count("trotd: no daemon to talk to") == 1
    assert not (tmp_path / "run").exists(), "nothing was begun"
