"""``python -m fitting creep FILE``: like the command `relaxation`, but the stress is imposed instead of the strain."""

from fitting.commands.relaxation import parser, run

__all__ = ["parser", "run"]
