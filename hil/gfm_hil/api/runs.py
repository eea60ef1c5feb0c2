"""Runs: of one converter, of a network, of several laws side by side; in memory or in a folder."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from gfm_hil.api.law import Law, law_files, scenario_under
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.engine.processes import Progress
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.recording.foreign import open_recording
from gfm_hil.recording.run import Run, converters_of, nominal_frequency
from gfm_hil.results.between_figure import plot_between
from gfm_hil.results.figures import draw_comparison, plot, plot_laws, plot_network, plot_waveforms
from gfm_hil.results.page import fragment
from gfm_hil.results.report import events_table, write_report, write_together
from gfm_hil.run import run_folder, runner
from gfm_hil.run.between import BetweenTicks, between_ticks
from gfm_hil.run.losses import losses
from gfm_hil.run.metrics import event_metrics
from gfm_hil.run.network_run import NetworkRun, save_network
from gfm_hil.run.runner import Notice
from gfm_hil.run.spectrum import spectrum
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.studies.workers import SILENT, Watch

__all__ = [
    "BetweenTicks", "Comparison", "NetworkRun", "Run", "compare", "load_run", "merge", "recover",
    "run", "run_network", "save",
]  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def save(run: Run | NetworkRun, folder: str | Path) -> Path:
    """Write the run folder, with figures and report, or that of a network; returns it.

    A law that was an object is there as ``law.toml``, which the scenario names.

    Raises:
        UserError: the folder holds something already, or cannot be written.
    """
    if isinstance(run, NetworkRun):
        return save_network(run, folder, write_report)
    return run_folder.save(run, folder, write_report)


def look_between_ticks(run: Run, start: float, stop: float, step: float = 1e-6) -> BetweenTicks:
    """What a switched bridge does between the ticks in a window of a run, which is repeated for it.

    Args:
        run: of one converter, whose law computed u.
        start, stop: from when to when, s.
        step: the longest time between two points, s; every edge and every end of a dead time is
            a point too.

    Raises:
        UserError: the bridge is averaged, the window is none, the controller is not ours, or the
            run cannot be repeated, as one in real time with misses.
    """
    law = Law.from_toml(run.law_text) if run.law_text else run.scenario.law
    with scenario_under(law, run.scenario) as scenario:
        return between_ticks(run, scenario, start, stop, step)


def run_as_html(run: Run) -> str:
    """The status and the metrics of a run, rounded, for a notebook."""
    words = repr(run).removeprefix("<Run ").removesuffix(">")
    return fragment(replace(events_table(run.summary["events"]), title=words))


# what a run does by functions of rooms above its own
Run.plot, Run.plot_waveforms, Run.save = plot, plot_waveforms, save
Run._repr_html_, Run.between_ticks = run_as_html, look_between_ticks
BetweenTicks.spectrum, BetweenTicks.losses, BetweenTicks.plot = spectrum, losses, plot_between
NetworkRun.plot, NetworkRun.save = plot_network, save


def _silent(*_: object) -> None:
    """Neither progress nor notices."""


def _on_stderr(text: str) -> None:
    """A notice for a person who waits at a prompt or in a notebook."""
    print(text, file=sys.stderr, flush=True)


def explain_and_report(run: Run | NetworkRun) -> None:
    """Write the figures and the report of a run, and into its summary what its linear loop says of
    it: which mode ended it, and how many missed ticks its law bears. Of a network the converters
    come first, one by one."""
    if isinstance(run, Run):
        if run.scenario.network is None and run.status not in ("completed", "interrupted"):
            from gfm_hil.studies.linear_loop import why_it_ended  # a second of imports

            if why := why_it_ended(run):
                run.summary["unstable_mode"] = why
        if run.summary["mode"] == "realtime":
            from gfm_hil.studies.latency import in_a_row_words

            if words := in_a_row_words(run):
                run.summary["latency"] = words
    write_report(run)


def run(
    scenario: str | Path | Scenario | dict[str, Any],
    law: str | Path | Law | None = None,
    folder: str | Path | None = None,
    *,
    controller: str | None = None,
    ports: str | Path | None = None,
    figures: bool = True,
    progress: Progress = _silent,
    notice: Notice | None = None,
    **changes: Any,
) -> Run:
    """Run a scenario.

    Without a folder it runs in this process, in lockstep, and the result stays in memory. With one
    it runs as ``gfmhil run`` does: over the scenario's link and in its mode, and leaves a run
    folder.

    Args:
        scenario: name of a shipped one, path of a file, content of a file, or a checked scenario.
        law: name, law file or ``Law``; the scenario's own if None.
        folder: run folder, new or empty; None for a run in memory.
        controller: ``dll:FILE``, ``fmu:FILE`` or ``c:FILE``, which computes u in place of the law;
            or ``pil:TARGET``, the law on a processor in QEMU, or ``pil:TARGET:FOLDER`` with a
            firmware around it. It takes a folder and a link.
        ports: file of the map of its ports.
        figures: in the folder, figures and report.html.
        progress: is called with the ticks done and the misses so far; with a folder.
        notice: is called with a line for a person who waits. None: a run in memory says on stderr
            what it compiles, which happens once a machine; one with a folder says nothing.
        changes: keys of the scenario with ``__`` for the dot, e.g. ``duration=2.0`` [s],
            ``plant__factors__L_g=2.0``.

    Raises:
        UserError: one line a mistake; or the scenario has no operating point.
        LawError: the law is none.
    """
    if folder is not None:
        if isinstance(law, Law):
            raise UserError(f"law = {law.name!r}: save it first, as the folder names its file")
        checked = load_scenario(scenario, law=law, **changes)
        notice = notice or _silent
        command = runner.controller_program(checked, controller, ports, notice)
        report = explain_and_report if figures else None
        return runner.run_scenario(checked, Path(folder), progress, notice, report, command)
    if controller is not None or ports is not None:
        raise UserError("controller, ports: take a folder")
    with scenario_under(law, scenario, **changes) as checked:
        made = runner.run_in_memory(checked, notice=notice or _on_stderr)
    return _with_name(made, law) if isinstance(law, Law) else made


def run_network(
    scenario: str | Path | Scenario | dict[str, Any],
    folder: str | Path | None = None,
    *,
    controllers: Mapping[str, str] = MappingProxyType({}),
    ports: Mapping[str, str | Path] = MappingProxyType({}),
    figures: bool = True,
    progress: Progress = _silent,
    notice: Notice | None = None,
    **changes: Any,
) -> NetworkRun:
    """Run a scenario with several converters; arguments as for ``run``.

    Args:
        controllers, ports: by converter, what computes its u in place of its law, and the map of
            that. They take a folder and a link.

    Raises:
        UserError: one line a mistake; it has no network; or no operating point.
    """
    checked = load_scenario(scenario, in_process=folder is None, **changes)
    if checked.network is None:
        raise UserError("network: the scenario has none; use gfmhil.run")
    for name in (*controllers, *ports):
        if name not in checked.parts:
            raise UserError(
                f"controller of {name}: the network has no such converter; it has"
                f" {', '.join(checked.parts)}"
            )
        if name not in controllers:
            raise UserError(f"map of {name}: is of a controller; name it too")
    if folder is None:
        if controllers:
            raise UserError("controllers: take a folder")
        return runner.run_network_in_memory(checked, notice or _on_stderr)
    notice = notice or _silent
    commands = {
        name: runner.controller_program(checked.each[name], controller, ports.get(name), notice)
        for name, controller in controllers.items()
    }
    report = explain_and_report if figures else None
    return runner.run_network(checked, Path(folder), progress, notice, report, commands)


def _with_name(made: Run, law: Law) -> Run:
    """The run of a ``Law``: its name in place of its temporary file, and its text."""
    scenario = made.scenario.model_copy(update={"law": law.name})
    return replace(made, scenario=scenario, law_text=law.to_toml())


def load_run(
    folder: str | Path,
    map: str | Path | None = None,
    scenario: str | Path | Scenario | dict[str, Any] | None = None,
) -> Run:
    """A run from its folder, see ``Run.load``; or a recording that others made.

    Args:
        folder: of a run, or the recording: CSV, COMTRADE (its .cfg or .cff), Parquet, MF4 or MAT.
        map: of a recording, the file that says what its channels are.
        scenario: of a recording, what was done, as for ``run``. It is aligned to the first event.

    Raises:
        UserError: a file cannot be read, a channel is missing, or the recording does not begin
            where the scenario does.
    """
    if map is None and scenario is None:
        if Path(folder).is_file():
            raise UserError(f"{folder}: a recording takes its map and the scenario")
        return Run.load(folder)
    if map is None or scenario is None:
        raise UserError(f"{folder}: a recording takes both, its map and the scenario")
    return open_recording(folder, map, load_scenario(scenario, in_process=True))


def recover(folder: str | Path) -> Run | NetworkRun:
    """Complete the folder of a run that a kill, a power failure or a full disk cut off; leave one
    that is complete as it is.

    Raises:
        UserError: it is no run folder, the run is still going on, its recording is gone, or a file
            is none of a run.
    """
    folder = Path(folder)
    if converters_of(folder):
        return NetworkRun.recover(folder, explain_and_report)
    return run_folder.recover(folder, explain_and_report)


def merge(
    first: str | Path, second: str | Path | Sequence[str | Path], folder: str | Path
) -> Run | NetworkRun:
    """One run folder from those of a controller and a plant that were started separately; of a
    network from that of its plant, ``first``, and those of the controllers of all its converters.

    Raises:
        UserError: a folder is not that of one side, they are not of the same run or of the same
            converter, or ``folder`` is in use or cannot be written.
    """
    others = [Path(one) for one in ([second] if isinstance(second, str | Path) else second)]
    if converters_of(Path(first)):
        return NetworkRun.merge(Path(first), others, Path(folder), explain_and_report)
    if len(others) != 1:
        raise UserError(f"{first}: is not of a network, whose folders may be more than two")
    return run_folder.merge_roles(Path(first), others[0], Path(folder), explain_and_report)


class Comparison(dict[str, Run]):
    """Runs of one scenario by the name of their law; of a network by converter and law, as
    ``A: vsg-2``."""

    @property
    def metrics(self) -> dict[str, dict[str, dict[str, Any]]]:
        """The metrics of each run by law, see ``Run.metrics``."""
        return {law: one.metrics for law, one in self.items()}

    @property
    def summaries(self) -> dict[str, dict[str, Any]]:
        """The summary of each run by law, which comparison.json holds."""
        return {law: one.summary for law, one in self.items()}

    @property
    def converters(self) -> dict[str, Comparison]:
        """The runs of each converter of a network by law; all under "" without a network."""
        found: dict[str, Comparison] = {}
        for name, one in self.items():
            of = one.scenario.converter or ""
            found.setdefault(of, Comparison())[name.removeprefix(f"{of}: ")] = one
        return found

    @property
    def events(self) -> list[dict[str, Any]]:
        """Those of the summary of the run that came furthest, of each converter of a network."""
        found: dict[tuple[float, str], dict[str, Any]] = {}
        for runs in self.converters.values():
            for event in max((one.summary["events"] for one in runs.values()), key=len):
                found.setdefault((event["t"], event["label"]), event)
        return [found[key] for key in sorted(found, key=lambda at: at[0])]

    def plot(self, *names: str, **look: Any) -> list[Axes]:
        """Draw signals of all laws, one a panel; p, frequency, q and v_dc without names.

        Args:
            look: ``signals``, ``ax``, ``xlim``, ``size`` and ``style``, as of ``Run.plot``.
        """
        return list(plot_laws(self, *names, **look))

    def write(self, folder: Path) -> None:
        """Write comparison.json, and comparison.png and report.html of the runs that recorded
        anything."""
        first = next(iter(self.values())).scenario
        signals = {law: one.columns for law, one in self.items() if "true_p" in one.columns}
        if signals:
            kind = "law" if first.network is None else "run"
            draw_comparison(folder / "comparison.png", first, signals, self.events)
            write_together(folder, first, self, self.events, kind, "comparison.png")
        write_text(folder / "comparison.json", json.dumps(self.summaries, indent=2) + "\n")

    def __repr__(self) -> str:
        lines = [f"  {law}: {one.status}" for law, one in self.items()]
        return "\n".join(["<Comparison", *lines, ">"])


def compare(
    scenario: str | Path | Scenario | dict[str, Any],
    laws: Sequence[str | Path | Law],
    folder: str | Path | None = None,
    *,
    converter: str | None = None,
    recording: str | Path | None = None,
    map: str | Path | None = None,
    watch: Watch = SILENT,
    **changes: Any,
) -> Comparison:
    """Run a scenario under several laws.

    Args:
        scenario, changes: as for ``run``; or with a network, of which every converter is compared.
        laws: names, law files or ``Law``.
        folder: where to write a run folder for each law, report.html, comparison.png and
            comparison.json; the link and the mode are then those of the scenario. None keeps the
            runs in memory.
        converter: of a network: the one that gets each law; all of them by default, if none has
            its own.
        recording, map: a recording of the same that others made, which is laid beside the runs
            under the name of its file, and the file that says what its channels are.
        watch: of the runs with a folder.

    Raises:
        UserError: one line a mistake; the folder is in use; or the scenario has no operating point.
        LawError: a law is none.
    """
    if not laws:
        raise UserError("laws: name some laws to compare")
    beside = {}
    if recording is not None or map is not None:
        if recording is None or map is None:
            raise UserError("recording, map: give both or none")
        done = load_scenario(scenario, in_process=True, **changes)
        if done.network is not None:
            raise UserError("recording: is of one converter, the scenario has a network")
        beside = {Path(recording).name: _with_metrics(open_recording(recording, map, done))}
    names = {"converter": "converter (--converter)"}  # in Python and on the command line
    with law_files(laws) as files:
        scenarios = {
            name: load_scenario(scenario, names, folder is None, converter, law=file, **changes)
            for name, file in files.items()
        }
        if folder is not None:
            return _compare_in(Path(folder), scenarios, beside, watch)
        made = {}
        for (name, one), law in zip(scenarios.items(), laws, strict=True):
            runs = _of_converters(
                runner.run_network_in_memory(one) if one.parts else runner.run_in_memory(one)
            )
            if isinstance(law, Law):
                runs |= {n: _with_name(r, law) for n, r in runs.items() if converter in (None, n)}
            made[name] = runs
    return _comparison(made, beside)


def _of_converters(made: Run | NetworkRun) -> dict[str, Run]:
    """The runs by converter, "" without a network."""
    return made.runs.copy() if isinstance(made, NetworkRun) else {"": made}


def _comparison(made: Mapping[str, Mapping[str, Run]], beside: Mapping[str, Run]) -> Comparison:
    """The runs by law and converter, as ``_of_converters`` has them, converter by converter;
    ``beside`` come first."""
    found = Comparison(beside)
    for converter in dict.fromkeys(name for runs in made.values() for name in runs):
        for law, runs in made.items():
            found[f"{converter}: {law}" if converter else law] = runs[converter]
    return found


def _with_metrics(recorded: Run) -> Run:
    """A recording with what followed each event, as far as it shows it."""
    columns, events = recorded.columns, recorded.summary["events"]
    f_n, T_s = nominal_frequency(recorded.scenario), recorded.scenario.T_s
    if "true_omega_u" not in columns:
        return recorded
    ends = [*(e["tick"] for e in events[1:]), recorded.ticks]
    told = [e | event_metrics(columns, e["tick"], end, T_s, f_n)
            for e, end in zip(events, ends, strict=True)]  # fmt: skip
    told = [{k: None if isinstance(x, float) and math.isnan(x) else x for k, x in e.items()}
            for e in told]  # fmt: skip
    return replace(recorded, summary=recorded.summary | {"events": told})


def _compare_in(
    folder: Path, scenarios: Mapping[str, Scenario], beside: Mapping[str, Run], watch: Watch
) -> Comparison:
    """Run scenarios of different laws, each in a folder; an interruption ends all. ``beside`` are
    those that are run already."""
    first = next(iter(scenarios.values()))
    ticks, converters = first.ticks * len(scenarios), max(1, len(first.parts))
    run_folder.check_free(folder, ticks, ColumnSet.of(first), converters)
    made: dict[str, dict[str, Run]] = {}
    for name, one in scenarios.items():

        def tell(ticks: int, misses: int, name: str = name, one: Scenario = one) -> None:
            late = f", {misses} misses" if misses else ""
            said = f"{name}: {ticks * one.T_s:.2f} s simulated{late}"
            watch.progress(len(made) * one.ticks + ticks, len(scenarios) * one.ticks, said)

        start = runner.run_network if one.parts else runner.run_scenario
        whole = start(one, folder / name, tell, watch.notice, explain_and_report)
        made[name] = _of_converters(whole)
        if whole.status == "interrupted":
            break
    found = _comparison(made, beside)
    found.write(folder)
    return found
