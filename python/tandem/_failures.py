"""Exceptions of a user's environment or policy: their text, their place and their tracebacks."""

from __future__ import annotations

import dataclasses
import os
import sys
import sysconfig
import threading
import traceback

_PACKAGE = os.path.join(os.path.dirname(__file__), "")
_STANDARD_LIBRARY = os.path.join(sysconfig.get_path("stdlib"), "")


@dataclasses.dataclass(frozen=True)
class Raised:
    """An exception, in a form that can be sent to another process."""

    text: str
    """Type, text and place, such as `KeyError: 'x' (reach.py:31)`."""
    place: tuple[str, int, str]
    """File, line and type."""
    traceback: str

    @classmethod
    def of(cls, error: BaseException) -> Raised:
        """Returns the description of an exception that was caught.

        Its place is the innermost line of the user's own code. If there is none, it is that of an installed package.
        """
        kind = type(error).__name__
        found = _own_lines(error) or [line for line in _lines(error) if not line[0].startswith(_PACKAGE)]
        file, number = found[-1] if found else ("", 0)
        place = f" ({os.path.basename(file)}:{number})" if found else ""
        return cls(f"{kind}: {error}{place}", (file, number, kind), "".join(traceback.format_exception(error)))


class Tracebacks:
    """Prints tracebacks to standard error, once for each place, so that an environment cannot fill a log."""

    def __init__(self) -> None:
        self._printed: set[tuple[str, int, str]] = set()
        self._lock = threading.Lock()

    def print(self, title: object, raised: Raised | None) -> None:
        """Prints the traceback of an exception, if there is one, below `title`."""
        with self._lock:
            if raised is None or raised.place in self._printed:
                return
            self._printed.add(raised.place)
            print(f"{title}\n{raised.traceback}", end="", file=sys.stderr, flush=True)


def is_in_own_code(error: BaseException) -> bool:
    """Returns whether an exception passed through code that is neither this package nor an installed one."""
    return bool(_own_lines(error))


def _own_lines(error: BaseException | None) -> list[tuple[str, int]]:
    """Returns the lines of a user's own code, innermost last.

    Gymnasium raises another exception when a constructor fails, so those before it are searched as well.
    """
    while error is not None:
        own = [line for line in _lines(error) if not _is_installed(line[0])]
        if own:
            return own
        error = error.__cause__ or error.__context__
    return []


def _lines(error: BaseException) -> list[tuple[str, int]]:
    """Returns file and line of each frame, innermost last."""
    return [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]


def _is_installed(file: str) -> bool:
    directories = (_PACKAGE, _STANDARD_LIBRARY, "<frozen ")
    return file.startswith(directories) or "site-packages" in file or "dist-packages" in file
