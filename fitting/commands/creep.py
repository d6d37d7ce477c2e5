"""``python -m fitting creep FILE``: the command `relaxation` for a test in which the stress is imposed in place of the
strain."""

from fitting.commands.relaxation import parser, run

__all__ = ["parser", "run"]
