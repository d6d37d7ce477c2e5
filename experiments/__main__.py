"""``python -m experiments all | pages | NAME … [--quick]``: run scripts, then write the pages that quote them."""

import argparse
import subprocess
import sys
import time
from pathlib import Path

from experiments.common import SKIPPED
from experiments.pages.overview import ROWS
from experiments.pages.write import record, write

HERE = Path(__file__).parent


def module(script: str) -> str:
    """Return the module name of a script, given the name of the script."""
    (file,) = (found for found in HERE.glob(f"*/{script}.py") if found.parent.name != "pages")
    return f"experiments.{file.parent.name}.{script}"


def run(script: str, quick: bool) -> bool:
    """Run one script in a separate process. Return whether it ended without error or reported that this machine lacks
    what it needs.
    """
    begin = time.perf_counter()
    command = [sys.executable, "-m", module(script), *(["--quick"] if quick else [])]
    code = subprocess.run(command, cwd=HERE.parent).returncode
    seconds = time.perf_counter() - begin
    ended = {0: "done", SKIPPED: "skipped"}.get(code, f"exit code {code}")
    print(f"{script}: {ended} after {seconds:.0f} s", flush=True)
    if code == 0:
        record(script, "quick" if quick else "full", seconds)
    return code in (0, SKIPPED)


def main(arguments: list[str] | None = None) -> int:
    """Run the command. Return 0 if every script ended without error."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description="Run experiments and write the pages.")
    parser.add_argument("names", nargs="+", choices=["all", "pages", *ROWS], metavar="all | pages | NAME")
    parser.add_argument(
        "--quick", action="store_true", help="smaller cases, into results/quick: all in about 40 minutes"
    )
    options = parser.parse_args(arguments)
    scripts = list(ROWS) if "all" in options.names else [n for n in options.names if n != "pages"]
    good = [run(script, options.quick) for script in scripts]
    write()
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
