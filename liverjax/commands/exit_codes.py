"""Run a command and end it with an exit code. An error is reported in one sentence."""

import argparse
import errno
import io
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from liverjax.core import program_cache
from liverjax.core.errors import InputError

#: Error numbers of a full disk and of an exhausted disk quota. Not every system has quotas.
FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}
#: Exit code after Ctrl-C, as in shells.
STOPPED = 130


def show_unknown_letters() -> None:
    """Show "?" for characters that the terminal cannot display, e.g. "±". Call this function before the command line
    is parsed."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def exit_code(run: Callable[[argparse.Namespace], int], options: argparse.Namespace, resumable: bool = False) -> int:
    """Run a command and return its exit code. The exit code is 2 for unusable input or a full disk, and 130 for Ctrl-C.

    Compiled programs are kept on disk for the next command (see `liverjax.core.program_cache`). If `options` has
    `optional_files`, a note lists the optional files in the folder of results that come from an earlier run.

    Args:
        run: function that runs the command with its options and returns 0 or 1.
        options: the parsed command line.
        resumable: whether an interrupted run can be continued with --resume.
    """
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
        begin = time.time()
        try:
            with program_cache.kept_on_disk():
                code = run(options)
            _tell_of_earlier_files(options, begin)
            return code
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print(
                "stopped" + ("; finished parts are kept: continue with --resume" if resumable else ""), file=sys.stderr
            )
            return STOPPED
        except BrokenPipeError:  # the reader of a pipe has closed it
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except OSError as error:
            if error.errno is None or error.errno not in FULL:
                raise
            print(
                f"error: the last file is not complete ({os.strerror(error.errno)}). Free disk space, and repeat the "
                "command",
                file=sys.stderr,
            )
            return 2


def end_if_stopped(code: int) -> None:
    """End the process immediately if its exit code is `STOPPED` (Ctrl-C).

    JAX may still compute in another thread. Python would wait for that thread, and the process could end with a crash.
    """
    if code == STOPPED:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _tell_of_earlier_files(options: argparse.Namespace, begin: float) -> None:
    """Print a note with the optional files in the folder of results that are older than this run. `begin`: time at
    which this run began."""
    known = (path for name in getattr(options, "optional_files", ()) for path in sorted(options.out.glob(name)))
    names = [path.name for path in known if _older(path, begin)]
    if names:
        verb = "is" if len(names) == 1 else "are"
        print(f"note: {', '.join(names)} in {options.out} {verb} from an earlier run", file=sys.stderr)


def _older(path: Path, begin: float) -> bool:
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path] * path.is_file()
    return bool(files) and max(file.stat().st_mtime for file in files) < begin
