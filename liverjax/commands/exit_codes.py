"""Run a command and end it with an exit code. An error is reported in one sentence."""

import argparse
import contextlib
import errno
import io
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from liverjax.core import program_cache
from liverjax.core.errors import InputError

#: Error numbers of a full disk, of a file above the maximum size and of an exhausted disk quota. Not every system has
#: quotas.
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
#: Exit code for unusable input or a full disk.
UNUSABLE = 2
#: Exit code after Ctrl-C, as in shells.
STOPPED = 130


def show_unknown_letters() -> None:
    """Show "?" for characters that the terminal cannot display, e.g. "±". Call this function before the command line
    is parsed."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


class _Unbroken:
    """A wrapper of standard output or standard error that raises no `BrokenPipeError`. If the reader has closed the
    pipe, the text is lost, and the command continues."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        try:
            return self.stream.write(text)
        except BrokenPipeError:
            self._discard()
            return len(text)

    def flush(self) -> None:
        try:
            self.stream.flush()
        except BrokenPipeError:
            self._discard()

    def _discard(self) -> None:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), self.stream.fileno())

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


def exit_code(run: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run a command and return its exit code. The exit code is 2 for unusable input or a full disk, and 130 for Ctrl-C.

    Compiled programs are kept on disk for the next command (see `liverjax.core.program_cache`). A command whose output
    goes to a closed pipe continues to its end.

    Args:
        run: function that runs the command with its options and returns 0 or 1.
        options: the parsed command line. The attribute `optional_files`, if present, contains name patterns of files in
            the folder of results: a note lists the files that come from an earlier run. If the attribute `resume` is
            present, `kept` is present too: `kept(options)` returns the files that --resume needs to continue a run.
    """
    out, err = (stream if stream is None else _Unbroken(stream) for stream in (sys.stdout, sys.stderr))
    with warnings.catch_warnings(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
        begin = time.time()
        try:
            with program_cache.kept_on_disk():
                code = run(options)
            _tell_of_earlier_files(options, begin)
            print(end="", flush=True)
            return code
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            return UNUSABLE
        except KeyboardInterrupt:
            kept = "; continue with --resume" if _any_kept(options, begin) else ""
            print(f"stopped{kept}", file=sys.stderr)
            return STOPPED
        except OSError as error:
            if error.errno is None or error.errno not in FULL:
                raise
            resume = " with --resume" if _any_kept(options, begin) else ""
            print(
                f"error: the last file is not complete ({os.strerror(error.errno)}). Free disk space, and repeat the "
                f"command{resume}",
                file=sys.stderr,
            )
            return UNUSABLE
        finally:
            with contextlib.suppress(OSError):
                print(end="", flush=True)


def end_if_stopped(code: int) -> None:
    """End the process immediately if its exit code is `STOPPED` (Ctrl-C) or `UNUSABLE`.

    After Ctrl-C JAX may still compute in another thread. Python would wait for that thread, and the process could end
    with a crash. If the disk is full, HDF5 would try to write its file again, and would crash.
    """
    if code in (STOPPED, UNUSABLE):
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):  # the disk of the output is full
                print(end="", file=stream, flush=True)
        os._exit(code)


def _tell_of_earlier_files(options: argparse.Namespace, begin: float) -> None:
    """Print a note with the optional files in the folder of results that are older than this run. `begin`: time at
    which this run began."""
    known = (path for name in getattr(options, "optional_files", ()) for path in sorted(options.out.glob(name)))
    names = [path.name for path in known if _older(path, begin)]
    if names:
        verb = "is" if len(names) == 1 else "are"
        print(f"note: {', '.join(names)} in {options.out} {verb} from an earlier run", file=sys.stderr)


def _any_kept(options: argparse.Namespace, begin: float) -> bool:
    """Return whether --resume can continue the run. The files for this were written since `begin`, or the run itself
    was started with --resume."""
    kept = options.kept(options) if "resume" in options else ()
    return any(options.resume or not _older(file, begin) for file in kept)


def _older(path: Path, begin: float) -> bool:
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path] * path.is_file()
    return bool(files) and max(file.stat().st_mtime for file in files) < begin
