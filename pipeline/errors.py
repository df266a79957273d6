"""One error tree. A user's mistake ends in one line: which file, which place, what is wrong, how to mend it."""

from __future__ import annotations

from pathlib import Path


class TsmftisError(Exception):
    """Anything this project raises on purpose; `exit_code` is what the command line returns."""

    exit_code = 1


class InputError(TsmftisError):
    """The user's data or settings are wrong; nothing has been written."""

    exit_code = 2

    def __init__(self, where: Path | str, place: str, problem: str, mend: str) -> None:
        self.where, self.place, self.problem, self.mend = str(where), place, problem, mend
        super().__init__(" ".join(f"{self.where}: {place}: {problem}; {mend}".split()))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str, str]]:
        return type(self), (self.where, self.place, self.problem, self.mend)


class StageError(TsmftisError):
    """A stage could not do its work although the input was well formed."""
