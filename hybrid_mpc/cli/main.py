"""Entry point of ``hybrid-mpc``: commands, version, and errors that end with exit code 2."""

from __future__ import annotations

import io
import os
import sys
from importlib.metadata import entry_points
from typing import Annotated, Any

# Before numpy or torch are loaded: arrays here are small, so threads inside these libraries only cost time.
os.environ.setdefault("OMP_NUM_THREADS", "1")

try:
    import typer
    from rich.console import Console
    from rich.markup import escape
    from typer.core import TyperCommand, TyperGroup
except ImportError as missing:  # a model runs without the libraries of the command line
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
    "run": "finished stages are saved; repeat the command with --resume to continue",
    "reproduce": "finished parts are saved; repeat the command with --resume to continue",
    "explain": "finished steps are saved; repeat the command to continue",
    "benchmark": "finished fits and networks are saved; repeat the command to continue",
    "control": "finished loops are saved; repeat the command with --resume to continue",
    "tune": "finished trials are saved; repeat the command with --resume to continue",
    "study": "finished runs are saved; repeat the command with --resume to continue",
    "analyze": "figures and tables are incomplete; repeat the command with another --out",
    "predict": "tables and figures are incomplete; repeat the command with another --out",
    "monitor": "tables and figures are incomplete; repeat the command with another --out",
    "data": "the recordings are incomplete; repeat the command with another --out",
}
"""What a command leaves when Ctrl-C or the file system ends it, and how to continue."""


class Command(TyperCommand):
    """A command that explains options with several values: many users type ``--data *.csv``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As typer; an error about extra words names the options that take one value each time."""
        given = [word for word in args if word in self._repeated()]
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter:
            raise
        except Exception as error:  # typer does not export the class of its usage errors
            if given and "unexpected extra argument" in getattr(error, "message", ""):
                option = given[-1]
                error.message += f". {option} takes one value; repeat it: {option} A {option} B"  # type: ignore[attr-defined]
            raise

    def _repeated(self) -> set[str]:
        return {name for p in self.params if getattr(p, "multiple", False) for name in p.opts}


class Commands(TyperGroup):
    """All commands. User code that ends Python becomes an error, and a missing package is named with its extra."""

    def invoke(self, ctx: Any) -> Any:
        """As typer."""
        with no_exit(), named_extra("this command"):
            return super().invoke(ctx)


app = typer.Typer(
    name="hybrid-mpc",
    cls=Commands,
    help="Turn recordings and a rough ODE into a real-time nonlinear MPC with state observer and fault monitor.",
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
    """Turn recordings and a rough ODE into a real-time nonlinear MPC with state observer and fault monitor."""


def main() -> None:
    """Run the command line; an input error ends with a message and exit code 2, Ctrl-C with 130."""
    for stream in (sys.stdout, sys.stderr):  # characters that a terminal lacks are printed as escapes
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
    except BrokenPipeError:  # the reader of the output, e.g. a pager, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(BAD_INPUT)
    except OSError as error:
        from hybrid_mpc.files import reason

        place = f" {error.filename}" if error.filename is not None else ""
        errors.print(
            f"[bold red]error:[/] a file cannot be read or written{_escape(place)}: {_escape(reason(error))}"
        )
        _say_what_is_saved(errors)
        sys.exit(BAD_INPUT)
    except SystemExit as stop:
        if stop.code == CTRL_C:  # typer catches the KeyboardInterrupt and prints nothing
            errors.print("interrupted")
            _say_what_is_saved(errors)
        raise


def _say_what_is_saved(errors: Console) -> None:
    command = next((word for word in sys.argv[1:] if word in SAVED), "")
    if command:
        errors.print(SAVED[command])


def _escape(text: str) -> str:
    return escape(printable(text))
