"""The command line: a file a command, which parses, calls one function of the library and prints."""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default that of `sys.argv`, and return its exit code: 0 done, 1 the work failed, 2 bad usage
    or input."""
    from spacesim.cli import program  # not before: it takes Ctrl-C into its hands where the process is the command

    return program.main(arguments)
