"""The two ways in which work ends early, each told to the user in one sentence."""


class InputError(ValueError):
    """Bad usage or bad input: names the file or option, what was expected and what was found (exit code 2)."""


class WorkError(RuntimeError):
    """The input was fine but the work could not be done, e.g. memory or disk is short (exit code 1)."""


def expect(condition: bool, name: str, expected: str, found: object) -> None:
    """Raise InputError "name: expected ..., found ..." unless `condition` holds."""
    if not condition:
        raise InputError(f"{name}: expected {expected}, found {found!r}")
