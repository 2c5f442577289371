"""Entry point of ``hybrid-mpc``: commands, version, and errors that end with exit code 2."""

from __future__ import annotations

import io
import os
import sys
from importlib.metadata import entry_points
from typing import Annotated, Any

# Before numpy or torch are loaded: arrays here are small, threads inside them only cost time.
os.environ.setdefault("OMP_NUM_THREADS", "1")

try:
    import typer
    from rich.console import Console
    from rich.markup import escape
    from typer.core import TyperCommand, TyperGroup
except ImportError as missing:  # the online half installs without the command line's libraries
    raise SystemExit(
        f"hybrid-mpc: {missing}. Install the command line with: pip install 'hybrid-mpc[all]'"
    ) from None

from hybrid_mpc import __version__
from hybrid_mpc.cli import (
    analyze,
    benchmark,
    check,
    control,
    data,
    doctor,
    explain,
    export,
    monitor,
    new,
    predict,
    run,
    scenarios,
    study,
    tune,
)
from hybrid_mpc.errors import InputError, StorageError, named_extra, no_exit
from hybrid_mpc.rules import printable

BAD_INPUT, CTRL_C = 2, 130
SAVED = {
    "run": "finished stages are saved: the same command with --resume goes on",
    "reproduce": "what is done is saved: the same command with --resume goes on",
    "explain": "finished steps are saved: the same command goes on",
    "benchmark": "what is fitted and trained is saved: the same command goes on",
    "control": "finished loops are saved: the same command with --resume goes on",
    "tune": "finished trials are saved: the same command with --resume goes on",
    "study": "finished runs are saved: the same command with --resume goes on",
    "analyze": "figures and tables are not complete: the same command with another --out makes them anew",
    "predict": "tables and pictures are not complete: the same command with another --out makes them anew",
    "monitor": "tables and pictures are not complete: the same command with another --out makes them anew",
    "data": "the recordings are not complete: the same command with another --out makes them anew",
}
"""What is left where a command was ended by Ctrl-C or by the file system."""


class Command(TyperCommand):
    """A command that says how several files are given: ``--data *.csv`` is what everyone types first."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As typer does it; words that are left over name the options that take one value each time."""
        given = [word for word in args if word in self._repeated()]
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter:
            raise
        except Exception as error:  # typer keeps the class of its errors of usage to itself
            if given and "unexpected extra argument" in getattr(error, "message", ""):
                option = given[-1]
                error.message += f". {option} takes one value; give it once for each: {option} A {option} B"  # type: ignore[attr-defined]
            raise

    def _repeated(self) -> set[str]:
        return {name for p in self.params if getattr(p, "multiple", False) for name in p.opts}


class Commands(TyperGroup):
    """The commands. In all of them code of a user that ends Python is an error, and a package that is not installed is
    named with its extra.
    """

    def invoke(self, ctx: Any) -> Any:
        """As typer does it."""
        with no_exit(), named_extra("this command"):
            return super().invoke(ctx)


app = typer.Typer(
    name="hybrid-mpc",
    cls=Commands,
    help="Measurements and an ODE in, a guarded real-time nonlinear MPC out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("new", cls=Command, epilog=new.EXAMPLES)(new.new)
app.command("check", cls=Command, epilog=check.EXAMPLES)(check.check)
app.command("explain", cls=Command, epilog=explain.EXAMPLES)(explain.explain)
app.command("run", cls=Command, epilog=run.EXAMPLES)(run.run)
app.command("predict", cls=Command, epilog=predict.EXAMPLES)(predict.predict)
app.command("control", cls=Command, epilog=control.EXAMPLES)(control.control)
app.command("analyze", cls=Command, epilog=analyze.EXAMPLES)(analyze.analyze)
app.command("benchmark", cls=Command, epilog=benchmark.EXAMPLES)(benchmark.benchmark)
app.command("data", cls=Command, epilog=data.EXAMPLES)(data.data)
app.command("tune", cls=Command, epilog=tune.EXAMPLES)(tune.tune)
app.command("monitor", cls=Command, epilog=monitor.EXAMPLES)(monitor.monitor)
app.command("scenarios")(scenarios.scenarios)
app.command("doctor")(doctor.doctor)
app.add_typer(study.app, name="study")
app.add_typer(export.app, name="export")
for entry in entry_points(group="hybrid_mpc.commands"):  # commands of scenarios, e.g. `reproduce`
    command = entry.load()
    app.command(entry.name, epilog=sys.modules[entry.module].EXAMPLES)(command)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"hybrid-mpc {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Measurements and an ODE in, a guarded real-time nonlinear MPC out."""


def main() -> None:
    """Run the command line; bad input ends with a message and exit code 2, Ctrl-C with 130."""
    for stream in (sys.stdout, sys.stderr):  # what a terminal's character set lacks is shown by number
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        app()
    except StorageError as error:
        errors.print(f"[bold red]error:[/] {_escape(str(error))}")
        _say_what_is_saved(errors)
        sys.exit(BAD_INPUT)
    except InputError as error:
        errors.print(f"[bold red]error:[/] {_escape(str(error))}")
        sys.exit(BAD_INPUT)
    except BrokenPipeError:  # who read the output, a pager say, has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(BAD_INPUT)
    except OSError as error:
        from hybrid_mpc.files import reason

        place = f" {error.filename}" if error.filename is not None else ""
        errors.print(f"[bold red]error:[/] the file system refused{_escape(place)}: {_escape(reason(error))}")
        _say_what_is_saved(errors)
        sys.exit(BAD_INPUT)
    except SystemExit as stop:
        if stop.code == CTRL_C:  # typer takes the KeyboardInterrupt and says nothing
            errors.print("interrupted")
            _say_what_is_saved(errors)
        raise


def _say_what_is_saved(errors: Console) -> None:
    command = next((word for word in sys.argv[1:] if word in SAVED), "")
    if command:
        errors.print(SAVED[command])


def _escape(text: str) -> str:
    return escape(printable(text))
