"""The command line: each command is a thin shell around one public function."""

from __future__ import annotations

import logging
import sys

import typer

from loopclosure.cli.console import fail
from loopclosure.errors import LoopClosureError

app = typer.Typer(
    name="loopclosure",
    help="Visual loop-closure detection: is the robot back at a place that it has seen?",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="rich",
)


def main() -> None:
    """Run the command line: exit status 0 done, 1 an error in one line on stderr, 2 wrong usage."""
    warnings = logging.StreamHandler(sys.stderr)
    warnings.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    logging.getLogger("loopclosure").addHandler(warnings)
    try:
        app(prog_name="loopclosure")
    except LoopClosureError as error:
        sys.exit(fail(str(error)))
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        sys.exit(fail(f"{error.filename or 'file system'}: {error.strerror or error}"))
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        logging.getLogger("loopclosure").removeHandler(warnings)


# They register their commands.
from loopclosure.cli import (
    bench,
    compare,
    datasets,
    detect,
    evaluate,
    explain,
    export,
    fit,
    reproduce,
    simulate,
    tables,
    train,
)
