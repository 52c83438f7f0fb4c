"""This computer: how punctual it is, and what the kernel and the environment grant."""

from __future__ import annotations

import os
import resource
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from runtime.ticker import Ticker
from trotd.check.rows import Row

SOAK_TIME = 2.0
"""s of the timing soak."""
LATENESS_SHARE = 0.25
"""Of a tick: how late the slowest percent may wake."""
LEAST_PRIORITY, LEAST_LOCKED = 1, 1 << 28
"""Of the limits: real-time priority, and bytes of locked memory."""


async def check_timing(rate_hz: float, seconds: float) -> Row:
    """How late ticks wake at ``rate_hz`` when nothing else is done in them."""
    lateness = []
    with Ticker(rate_hz) as ticker:
        for _ in range(max(2, round(seconds * rate_hz))):
            await ticker.wait()
            lateness.append(ticker.lateness)
        overruns = ticker.overruns
    return judge_timing(rate_hz, lateness, overruns)


def judge_timing(rate_hz: float, lateness: Sequence[float], overruns: int) -> Row:
    """A soak's lateness, s, and missed ticks."""
    p99 = float(np.percentile(lateness, 99))
    text = f"lateness p50 {np.median(lateness) * 1e6:.0f}, p99 {p99 * 1e6:.0f} µs, {overruns} overruns"
    bad = overruns > 0 or p99 > LATENESS_SHARE / rate_hz
    advice = "realtime settings, docs/operations.md" if bad else ""
    return Row(f"timing at {rate_hz:g} Hz", "warn" if bad else "ok", text, advice)


def check_system(root: Path = Path("/")) -> list[Row]:
    """Processors, limits and threads; ``root`` is where /sys is."""
    return [*_check_cores(root), *_check_limits(), _check_threads()]


def _check_cores(root: Path) -> list[Row]:
    processors = root / "sys/devices/system/cpu"
    rows = []
    governors = {file.read_text().strip() for file in processors.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    if governors:
        slow = governors != {"performance"}
        rows.append(
            Row("CPU governor", "warn" if slow else "ok", ", ".join(sorted(governors)), "performance" if slow else "")
        )
    else:
        rows.append(Row("CPU governor", "ok", "none: the clock is not scaled here"))
    isolated = processors / "isolated"
    cores = isolated.read_text().strip() if isolated.exists() else ""
    rows.append(Row("isolated cores", "ok" if cores else "warn", cores or "none", "" if cores else "isolcpus= at boot"))
    return rows


def _check_limits() -> list[Row]:
    rows = []
    for name, limit, least in (
        ("real-time priority", resource.RLIMIT_RTPRIO, LEAST_PRIORITY),
        ("locked memory", resource.RLIMIT_MEMLOCK, LEAST_LOCKED),
    ):
        soft = resource.getrlimit(limit)[0]
        granted = soft == resource.RLIM_INFINITY or soft >= least or os.geteuid() == 0
        text = "unlimited" if soft == resource.RLIM_INFINITY else str(soft)
        rows.append(Row(name, "ok" if granted else "warn", text, "" if granted else "the systemd unit grants it"))
    return rows


def _check_threads() -> Row:
    threads = {key: os.environ.get(key, "unset") for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    one = set(threads.values()) == {"1"}
    found = ", ".join(f"{key}={value}" for key, value in threads.items())
    return Row("BLAS threads", "ok" if one else "warn", found, "" if one else "set both to 1")
