"""``python -m fitting creep FILE``: the command `relaxation` with the stress driven in place of the strain."""

from fitting.commands.relaxation import parser, run

__all__ = ["parser", "run"]
