"""The guard on leaks sees them."""

from __future__ import annotations

import pytest

pytest_plugins = ["pytester"]

LEAKY = """
import asyncio, threading, time

def test_task():
    async def main():
        asyncio.get_running_loop().create_task(asyncio.sleep(60))
        await asyncio.sleep(0)
    asyncio.run(main())

def test_thread():
    threading.Thread(target=time.sleep, args=(5,), daemon=True).start()

def test_clean():
    asyncio.run(asyncio.sleep(0))
"""


def test_a_leaked_task_and_a_leaked_thread_fail(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    from pathlib import Path

    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text().replace("GRACE = 3.0", "GRACE = 0.1"))
    pytester.makepyfile(LEAKY)
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(passed=3, errors=2)
    result.stdout.fnmatch_lines(["*tasks left behind*", "*threads left behind*"], consecutive=False)
