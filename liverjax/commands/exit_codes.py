"""How a command ends: its exit code, and one sentence for what stopped it."""

import argparse
import os
import sys
import warnings
from collections.abc import Callable

from liverjax.core import programs
from liverjax.core.errors import InputError


def exit_code(run: Callable[[argparse.Namespace], int], options: argparse.Namespace, resumable: bool = False) -> int:
    """Run a command; return its exit code, 2 for unusable input and 130 for Ctrl-C.

    Compiled programs are kept on disk for the next command, see `liverjax.core.programs`.

    Args:
        run: runs the command with its options and returns 0 or 1.
        options: the parsed command line.
        resumable: a stopped run can go on with --resume.
    """
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
        try:
            with programs.kept_on_disk():
                return run(options)
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("stopped" + ("; finished parts are kept: go on with --resume" if resumable else ""), file=sys.stderr)
            return 130  # as shells do
        except BrokenPipeError:  # the reader of a pipe has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
