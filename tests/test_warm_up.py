"""After the warm-up nothing is compiled or loaded: in the loop it would stall a walking robot for a second."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import gc, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from walks import Walk
from runtime.messages.mode import Mode, Request

def forms():
    return {str(d.py_func): len(d.signatures) for d in gc.get_objects() if isinstance(d, Dispatcher)}

walk = Walk(Path(sys.argv[1]))
before = forms()
walk.stand()
walk.ask(Request.WALK)
walk.run(1.0, (0.5, 0.1, 0.3))
walk.world.push((0.0, 150.0, 0.0), 0.1)
walk.run(1.0, (0.5, 0.0, 0.0))
walk.run(2.5)
walk.ask(Request.SIT)
walk.until(lambda: walk.cycle.state.mode is Mode.DAMP)
assert walk.recorder.count > 1000
late = {name: n for name, n in forms().items() if n != before.get(name, 0)}
print(*late, sep="\\n")
sys.exit(bool(late))
"""


def test_nothing_compiles_between_standing_up_and_sitting_down(tmp_path: Path) -> None:
    here = Path(__file__).parent
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path)],
        cwd=here,
        env={"PYTHONPATH": f"{here}:{here.parent}", "HOME": str(Path.home()), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr[-2000:]
