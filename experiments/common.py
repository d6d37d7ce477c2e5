"""Tasks common to all experiments: time a compiled function, record the environment, write JSON and PNG."""

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import matplotlib
import matplotlib.ticker

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from liverjax.core.versions import versions

# Compile times are those without a cache of compiled programs.
os.environ["LIVERJAX_CACHE"] = "off"
#: With this option, scripts run fewer and smaller cases, to check that everything runs. Published results stay as they
#: are.
QUICK = "--quick" in sys.argv[1:]
#: Exit code of a script that needs what this machine lacks. Its stored results and run time stay as they are.
SKIPPED = 77
ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "experiments" / "results" / ("quick" if QUICK else "")
plt.rcParams.update({"font.size": 9, "axes.titlesize": 9, "axes.grid": True, "grid.alpha": 0.3, "savefig.dpi": 150})


class Timing(NamedTuple):
    """Seconds of compilation, and median seconds of the rounds."""

    compile: float
    run: float


def timed(function: Callable, *arguments: Any, rounds: int = 5) -> tuple[Any, Timing]:
    """Return the result and timing of a jitted function: compile time, and median of `rounds` runs after a
    first one.
    """
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compiling = time.perf_counter() - begin
    result = jax.block_until_ready(compiled(*arguments))
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        seconds.append(time.perf_counter() - begin)
    return result, Timing(compiling, statistics.median(seconds))


def either(full: Any, quick: Any) -> Any:
    """Return `quick` with --quick on the command line, otherwise `full`."""
    return quick if QUICK else full


def environment() -> dict[str, Any]:
    """Return software versions and kind of machine for the results, without the name of the machine."""
    return versions() | {"cores": os.cpu_count(), "architecture": platform.machine(), "backend": jax.default_backend()}


def plain_ticks(*axes: Any) -> None:
    """Label logarithmic axes with the plain numbers 1, 2, 5, 10 …."""
    for axis in axes:
        axis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.set_minor_formatter(matplotlib.ticker.NullFormatter())


def save(name: str, content: dict[str, Any], figure: Any = None) -> None:
    """Write results/NAME.json and, with a figure, results/NAME.png."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content | {"environment": environment()}, indent=1, allow_nan=False)
    (RESULTS / f"{name}.json").write_text(text + "\n")
    if figure is not None:
        figure.savefig(RESULTS / f"{name}.png")
        plt.close(figure)
