"""The command lines ``python -m fitting SWEEP.csv …`` for frequency sweeps and ``python -m fitting COMMAND FILE …`` for
other tests. COMMAND is one of `COMMANDS`."""

import importlib
import sys

from liverjax.commands.arguments import with_joined_numbers
from liverjax.commands.exit_codes import end_if_stopped, exit_code, show_unknown_letters

#: Names of the commands for tests that are not frequency sweeps. A command line that begins with none of these names is
#: for a frequency sweep.
COMMANDS = ("curves", "field", "relaxation", "creep", "indentation", "amplitude", "waves")


def main(arguments: list[str] | None = None, prog: str = "python -m fitting") -> int:
    """Run a command line and return the exit code: 0 (done), 1 (not converged) or 2 (unusable input)."""
    show_unknown_letters()
    given = sys.argv[1:] if arguments is None else arguments
    name = "sweep"
    if given[:1] and given[0] in COMMANDS:
        name, given = given[0], given[1:]
        prog = f"{prog} {name}"
    command = importlib.import_module(f"fitting.commands.{name}")  # only this command is loaded, to save time
    options = command.parser(prog).parse_args(with_joined_numbers(given))
    code = exit_code(command.run, options)
    if arguments is None:
        end_if_stopped(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
