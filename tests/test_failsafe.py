"""The table of faults is whole, its document is the committed one, and every test that it names exists."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from runtime.failsafe import TABLE, document
from runtime.reasons import Reason

ROOT = Path(__file__).parents[1]
ELSEWHERE = {Reason.UNREACHABLE}
"""Faults that no body can show: the configuration is refused before."""


def test_the_committed_document_is_up_to_date() -> None:
    assert (ROOT / "docs" / "failsafe.md").read_text() == document(ROOT / "docs" / "torture.json"), (
        "make failsafe writes it"
    )


@pytest.mark.parametrize("named", sorted({row.test for row in TABLE}))
def test_the_test_that_is_named_exists(named: str) -> None:
    file, _, name = named.partition("::")
    tree = ast.parse((ROOT / file).read_text())
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_fault_has_its_row() -> None:
    told = {row.reason for row in TABLE}
    assert {reason for reason in Reason if reason.is_fault} - told == ELSEWHERE
    assert all(row.answer for row in TABLE)
