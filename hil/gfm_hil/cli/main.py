"""Argument parsing and exit codes.

0: done, and a run ended as its scenario expects; 1: a conformity test fails, or a report is worse
than the one before; 2: wrong input, nothing started; 3: a run ended otherwise, or its folder could
not be completed; 4: no conformity test fails, but one cannot be judged; 130: interrupted.
"""

import argparse
import atexit
import errno
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

from gfm_hil.ports import PORTS, make_port
from gfm_runtime.garbage import garbage_kept

#: each command's module (none: it is a port) and what it does. A module's ``add`` gives the
#: command's parser its options, ``call`` carries the command out and returns the exit code. Only
#: the module of the command that is called is imported, so that the light commands load no numba.
COMMANDS = {
    "run": ("run", "run a scenario and leave a run folder"),
    "command": ("command", "command a run that is going on, or print its newest tick"),
    "recover": ("recover", "complete the folder of a run that a kill or a full disk cut off"),
    "merge": ("merge", "join the run folders of a controller and a plant started separately"),
    **{name: ("", entry.text) for name, entry in PORTS.items()},
    "export": ("export", "write a run as MF4, CSV, MAT, Parquet, or its CAN frames as BLF"),
    "waveforms": (
        "waveforms",
        "show what a switched bridge does between the ticks of a run: ripple, spectrum, losses",
    ),
    "compare": ("compare", "run a scenario under several laws"),
    "campaign": ("campaign", "run a scenario many times with drawn values"),
    "conform": ("conform", "run published tests of grid-forming converters, and judge them"),
    "scan": ("scan", "measure a converter's dq admittance, and judge grids by it"),
    "certify": ("certify", "say in which grids any number of converters is stable"),
    "fit": ("fit", "fit D, H and X_eff to a run or a recording, with intervals"),
    "bench": ("bench", "measure links, clock, kernel and loop on this machine"),
    "laws": ("laws", "list the laws, or show one"),
    "firmware": ("firmware", "export laws as C99, FMUs and models; check them on a processor"),
    "design": ("design", "compute gamma, margins, and gains by H-infinity synthesis"),
    "dbc": ("dbc", "write the CAN link's DBC file, or its bus budget"),
    "warm-up": ("warm_up", "compile all that runs call, so that the first one starts at once"),
    "doctor": ("doctor", "check this machine's fitness for real time, and say what to improve"),
    "schema": ("schema", "write the JSON schema of a scenario, law or other file, for editors"),
    "new": ("new", "write a law or scenario file to start from, with comments"),
    "network": ("network", "make a network of a published power-flow case"),
    "scenarios": ("scenarios", "list the scenarios that ship"),
    "keys": ("keys", "make a key pair per role, for ZeroMQ between two machines"),
    "deploy": ("deploy", "write service units, container files and the tuning script to a folder"),
    "controller": ("roles", "start the controller alone; it binds the endpoint"),
    "plant": ("roles", "start the plant emulator alone; it connects to the endpoint"),
}

#: names of earlier versions, which go on working for one version
_EARLIER = {"identify": "scan", "tell": "command"}


class _Version(argparse.Action):
    """Looks the version up once it is asked for, which takes as long as everything else here."""

    def __init__(self, **more: Any) -> None:
        super().__init__(nargs=0, **more)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"gfmhil {version('gfmhil')}")
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """Names the choice that is most like an unknown one, and says what is wrong in one line."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, unknown = super().parse_known_args(args, namespace)
        if not hasattr(options, "parsed_by"):  # a sub-command's comes before its command's
            options.parsed_by = self
        return options, unknown

    def _print_message(self, message: str, file: Any = None) -> None:
        if file is sys.stdout and file is not None:  # argparse hides that a disk is full
            file.write(message)
        else:
            super()._print_message(message, file)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help)\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as problem:
            from gfm_runtime.errors import meant

            problem.message += meant(value, action.choices or ())
            raise


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser of one command with its options; that of no command only lists all of them."""
    top = _Parser(
        prog="gfmhil", description="Hardware-in-the-loop bench for grid-forming converter control."
    )
    top.add_argument("--version", action=_Version, help="print the version")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    if command in COMMANDS:
        module: Any = (
            make_port(command)
            if command in PORTS
            else import_module(f"gfm_hil.cli.{COMMANDS[command][0]}")
        )
        chosen = commands.add_parser(command)
        chosen.set_defaults(call=getattr(module, "call", None))  # some have only sub-commands
        module.add(chosen)
    else:
        for name, (_, text) in COMMANDS.items():
            commands.add_parser(name, help=text)
    return top


def program() -> int:
    """``main`` as a program, whose process ends with all that it holds: to take a million objects
    apart one by one takes a third of the time of a short command."""
    code = 1  # of a mistake of ours, whose traceback Python prints

    def end() -> None:
        status = code
        for stream in sys.stdout, sys.stderr:
            try:
                if stream is not None:
                    stream.flush()
            except BrokenPipeError:  # a reader that has seen enough
                pass
            except OSError as problem:
                status = _refuse(problem)
        os._exit(status)

    atexit.register(end)  # before all others, so that it comes last
    try:
        code = main()
    except SystemExit as stop:  # of argparse
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        raise
    except KeyboardInterrupt:
        code = 130
        raise
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in _EARLIER:
        now = _EARLIER[given[0]]
        note = f"is gfmhil {now} now; this name goes with version 2"
        print(f"gfmhil {given[0]}: {note}", file=sys.stderr)
        given[0] = now
    for text in given:
        if re.fullmatch("--[a-zA-Z_-]+=--", text):  # of which argparse makes an empty list
            why = "-- cannot be a value; for a file of that name write ./--"
            return _refuse(OSError(errno.EINVAL, why, text))
    if given and not given[0].startswith("-") and given[0] not in COMMANDS:
        from gfm_hil.core.errors import UserError
        from gfm_runtime.errors import allowed

        return _refuse(UserError(f"{given[0]}: no command; {allowed(given[0], COMMANDS)}"))
    try:
        with garbage_kept():  # a command's modules make a million objects, which stay
            top = parser(given[0] if given else None)
        if not given:
            top.print_help()
            return 0
        options, unknown = top.parse_known_args(given)
        if unknown:
            return _refuse(_unknown(options.parsed_by, unknown))
        return int(options.call(options))
    except KeyboardInterrupt as stop:
        if stop.args:  # what is left, and how to complete it
            print(f"gfmhil: {stop}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # a reader such as head that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to flush
        return 0
    except Exception as problem:
        return _refuse(problem)


def _unknown(parser: argparse.ArgumentParser, words: list[str]) -> Exception:
    """The error that a command does not know some of the words given to it."""
    from gfm_hil.core.errors import UserError
    from gfm_runtime.errors import meant

    known = {option for action in parser._actions for option in action.option_strings}
    first = words[0]
    close = meant(first.partition("=")[0], known)
    if first.endswith(".toml") and "--law" in known:
        place = "after --scenario" if "--scenario" in known else "before all options"
        close = f"; a law's file comes after --law, a scenario's {place}"
    elif "=" in first and not first.startswith("-"):
        close = "; an option changes what --help lists"
        if "--ramp" in known:
            close = "; references come right after the run folder, before all options"
        if "--set" in known:
            close = "; a key of the scenario comes after --set, e.g. --set references.P_ref=0.8"
    return UserError(f"{' '.join(words)}: {parser.prog} does not know it{close}")


def _refuse(problem: Exception) -> int:
    """Print what the user can mend, one line a mistake; returns the exit code. Raises Exception:
    the problem itself, if it is a mistake of ours."""
    from gfm_hil.core.errors import Unfinished, UserError  # these imports take longer than --help
    from gfm_runtime import LawError
    from gfm_runtime.errors import printable

    if isinstance(problem, OSError) and problem.filename is not None:  # a file that the user named
        text = f"{problem.filename}: {problem.strerror}"
    elif isinstance(problem, OSError) and problem.errno == errno.ENOSPC:  # for what is printed
        text = str(problem.strerror)
    elif isinstance(problem, UserError | LawError | Unfinished) or _no_equilibrium(problem):
        text = str(problem)
    else:
        raise problem
    said = "\n".join(printable(line) for line in text.split("\n"))
    print(f"gfmhil: {said}", file=sys.stderr)
    return 3 if isinstance(problem, Unfinished) else 2


def _no_equilibrium(problem: Exception) -> bool:
    from gfm_plant import NoEquilibrium  # with it comes numba

    return isinstance(problem, NoEquilibrium)
