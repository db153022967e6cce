"""The command line: arguments in, a result on standard output or one line of error. Nothing heavy is imported here."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from dvsviz.errors import DvsvizError, RunCancelled

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run `dvsviz` with arguments and return its exit code.

    0 for success, 2 for an error that the user can act on (one line on standard error), 130 after Ctrl-C.
    """
    from dvsviz.cli.arguments import parse

    try:
        code = parse(sys.argv[1:] if argv is None else argv).run()
        # A reader that has gone (`dvsviz info … | head`) is met here, not in the interpreter's last breath.
        sys.stdout.flush()
        return code
    except RunCancelled as error:
        _say(str(error))
        return EXIT_INTERRUPTED
    except DvsvizError as error:
        _say(f"error: {error}")
        return EXIT_ERROR
    except KeyboardInterrupt:
        _say("stopped")
        return EXIT_INTERRUPTED
    except MemoryError as error:
        _say(f"error: out of memory ({error}); give a shorter or smaller part, or a smaller sensor")
        return EXIT_ERROR
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _say(f"error: {where}{error.strerror or error}")
        return EXIT_ERROR


def _say(text: str) -> None:
    print("dvsviz:", " ".join(text.split()), file=sys.stderr)
