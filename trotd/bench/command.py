"""The sections by name, in order, and the command that runs them."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from enum import StrEnum

from trotd.bench.report import Figure, Finding, Missing, print_json, print_table


class Section(StrEnum):
    """What can be measured."""

    TICK = "tick"
    QP = "qp"
    TIMER = "timer"
    SIM = "sim"
    MEMORY = "memory"
    CODECS = "codecs"
    TRAINING = "training"
    REPLAY = "replay"
    LINK = "link"
    SENSES = "senses"


MODULES = {Section.SIM: "simulation"}


def measure(section: Section, quick: bool) -> Iterator[Finding]:
    """The findings of one section; one that cannot run here says why."""
    module = importlib.import_module(f"trotd.bench.{MODULES.get(section, section.value)}")
    try:
        yield from module.measure(quick)
    except ImportError as error:  # no simulator on this machine
        yield Missing(section.value, "", " ".join(str(error).split()))


def bench(sections: Sequence[Section], quick: bool, json: bool) -> bool:
    """Measure ``sections`` and print what was found, even if one breaks. Returns whether every bound was met."""
    findings: list[Finding] = []
    try:
        for section in sections:
            findings.extend(measure(section, quick))
    finally:
        (print_json if json else print_table)(findings)
    return all(finding.met is not False for finding in findings if isinstance(finding, Figure))
