"""``python -m trotd.bench``: the same as ``trotd bench``."""

import typer

from trotd.cli_bench import bench

typer.run(bench)
