"""The two ways in which work ends early, each reported to the user in one sentence."""


class InputError(ValueError):
    """Bad usage or bad input: names the file or option, what was expected and what was found (exit code 2)."""


class WorkError(RuntimeError):
    """The input was fine but the work could not be done, e.g. memory or disk is short (exit code 1)."""


def check_ranges(record: object, **ranges: tuple[float, float]) -> None:
    """Raise InputError "field: expected ... to ..., found ..." unless each of these fields of `record` is within its
    range, ends included."""
    for name, (least, most) in ranges.items():
        value = getattr(record, name)
        if not least <= value <= most:
            least_word, most_word = (str(end) if isinstance(end, int) else f"{end:g}" for end in (least, most))
            raise InputError(f"{name}: expected {least_word} to {most_word}, found {value!r}")


def check_type(value: object, kind: type, name: str, example: str) -> None:
    """Raise InputError "name: expected a Kind, such as ..., found ..." unless `value` is of that kind."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected a {kind.__name__}, such as {example}, found {type(value).__name__}")


def expect(condition: bool, name: str, expected: str, found: object) -> None:
    """Raise InputError "name: expected ..., found ..." unless `condition` holds."""
    if not condition:
        raise InputError(f"{name}: expected {expected}, found {found!r}")
