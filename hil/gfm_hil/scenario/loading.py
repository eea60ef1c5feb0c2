"""A scenario's file: found, read, overridden, checked whole, and written."""

import contextlib
import copy
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.core.files import write_text
from gfm_hil.scenario.events.base import PlantEvent
from gfm_hil.scenario.schema import INPROC, Scenario
from gfm_plant import ConverterParameters, Network, load_converter, make_network, make_plant
from gfm_plant.options import LINE
from gfm_plant.parted import find_places
from gfm_runtime import BuiltLaw, LawError, discretise, load_law
from gfm_runtime.counts import named_counts
from gfm_runtime.errors import allowed, meant, printable
from gfm_runtime.inner_file import named_inner
from gfm_runtime.signals import COUNTS
from gfm_runtime.toml_file import read_toml

SCENARIO_FOLDERS = (
    Path(__file__).resolve().parents[1] / "scenarios",  # in a wheel
    Path(__file__).resolve().parents[3] / "scenarios",  # in a checkout
)


def find_scenario(name: str) -> Path:
    """The file of a scenario: a path, or the name of a shipped one (with or without .toml). Raises
    UserError: neither exists."""
    return find_file("scenario", name, "*.toml")


def find_file(kind: str, name: str, pattern: str) -> Path:
    """The file at that path, or the shipped file of that name; ``kind`` is for the message. Raises
    UserError: neither exists."""
    given, shipped = Path(name), _shipped_files(pattern)
    try:
        is_file, exists = given.is_file(), given.exists()
    except OSError as problem:  # for example a name of 300 characters
        raise UserError(printable(f"{kind} {name}: {problem.strerror}")) from None
    if is_file:
        return given
    if given.name.removesuffix(".toml") in shipped:
        return shipped[given.name.removesuffix(".toml")]
    what = "is not a regular file" if exists else "no such file"
    known = allowed(given.stem, sorted(shipped), "shipped are")
    raise UserError(printable(f"{kind} {name}: {what}; {known}"))


def _shipped_files(pattern: str) -> dict[str, Path]:
    return {p.stem: p for folder in SCENARIO_FOLDERS for p in folder.glob(pattern)}


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with gfmhil."""
    return sorted(_shipped_files("*.toml"))


def load_scenario(
    given: str | Path | Scenario | dict[str, Any],
    options: Mapping[str, str] = MappingProxyType({}),
    in_process: bool = False,
    converter: str | None = None,
    **changed: Any,
) -> Scenario:
    """Read, override and check a scenario, its laws and its plant.

    Args:
        given: path or shipped name; content of a file; or a checked scenario, which comes back
            itself, in no time, if nothing changes.
        options: what the user calls an override, by its name in ``changed``, e.g.
            ``{"link__type": "--link"}``; messages name it in place of the file.
        in_process: the caller runs it in this process: the link is ``inproc`` unless ``changed``
            names another one. Messages do not mention this choice, because the user did not make
            it.
        converter: of a network: the one that gets ``law`` and ``inner`` of ``changed``. Without it
            all converters get them, so that none may name its own.
        changed: overrides by dotted path with ``__`` for the dot, e.g. ``link__type="inproc"``, or
            ``events__0__V_g=0.2`` of the first event; None leaves the file's value. A link other
            than the file's drops the file's endpoint and options, and ``plant__grid__scr`` its
            factors of the line. The link ``inproc`` implies
            lockstep unless a ``mode`` is given.

    Raises:
        UserError: one line per mistake, each with its path, the value and what is allowed.
    """
    where, content = "scenario", {}
    overrides = {key: value for key, value in changed.items() if value is not None}
    if isinstance(given, Scenario) and not (overrides or in_process or converter):
        return given
    if isinstance(given, str | Path):
        where = str(find_scenario(str(given)))
        try:
            content = read_toml(where)
        except ValueError as problem:
            raise UserError(f"{where}: {problem}") from None
        look_beside(content, Path(where).parent)
        if "phi" in content:
            raise UserError(f"{where}: is a law file; give it to a scenario as its law")
    elif isinstance(given, Scenario):
        content = given.model_dump(mode="json", exclude_none=True)
    else:
        content = copy.deepcopy(given)
    overrides, options = _of_converter(content, converter, overrides, options)
    implied: dict[str, Any] = {}
    if in_process or overrides.get("link__type") == INPROC:
        implied = {"link__type": INPROC, "mode": "lockstep"}
    link, chosen = content.get("link"), overrides.get("link__type")
    if isinstance(link, dict) and chosen not in (None, INPROC, link.get("type", "zmq")):
        link.pop("endpoint", None)  # they belong to the file's link
        link.pop("options", None)
    if "plant__grid__scr" in overrides or "scr" in (overrides.get("plant__grid") or {}):
        drop_line(content)
    if in_process or chosen is not None:  # one link for all
        for member in _inside(content, "network", "converters").values():
            if isinstance(member, dict):
                member.pop("link", None)
    for key, value in (implied | overrides).items():
        table: Any = content
        *parents, last = key.split("__")
        for parent in parents:
            if isinstance(table, list):
                table = table[_place(key, parent, table, options)]
            else:
                table = table.setdefault(parent, {}) if isinstance(table, dict) else None
        if isinstance(table, list):
            table[_place(key, last, table, options)] = value
        elif isinstance(table, dict):  # else the check reports what the file has instead
            table[last] = value
    named = {
        tuple(
            int(p) if p.isdigit() else p for p in key.split("__")
        ): f"{options.get(key, key.replace('__', '.'))} {value}"
        for key, value in overrides.items()
    }
    return check_scenario(content, where, named)


def drop_line(content: Mapping[str, Any]) -> None:
    """Take the factors of a scenario's own line out of its content: an SCR comes in their place."""
    for name in LINE:
        _inside(content, "plant", "factors").pop(name, None)


def _place(key: str, part: str, entries: list[Any], options: Mapping[str, str]) -> int:
    """The place that a part of an override's key names. Raises UserError: there is none."""
    if not part.isdigit() or int(part) >= len(entries):
        name = options.get(key, key.replace("__", "."))
        raise UserError(f"{name}: {part!r} must be one of {len(entries)} entries, counted from 0")
    return int(part)


def _of_converter(
    content: dict[str, Any],
    converter: str | None,
    overrides: dict[str, Any],
    options: Mapping[str, str],
) -> tuple[dict[str, Any], Mapping[str, str]]:
    """Overrides and their names as for ``load_scenario``, with ``law`` and ``inner`` where they
    reach the converters of a network. Raises UserError: there is no such converter; none is named,
    and one has its own law or stage."""
    members = _inside(content, "network", "converters")
    if converter is not None and converter not in members:
        allowed = f"must be one of {[*members]}" if members else "the scenario has no network"
        option = options.get("converter", "converter")
        raise UserError(f"{option} {converter}: {allowed}{meant(converter, members)}")
    if converter is None and members:
        converter = content.get("converter")  # the folder of a converter knows it
    found, names = dict(overrides), dict(options)
    for key in ("law", "inner"):
        if key not in overrides or not members:
            continue
        named = options.get(key, key)
        if converter is not None:
            own = f"network__converters__{converter}__{key}"
            found[own], names[own] = found.pop(key), named
        elif owners := [n for n, m in members.items() if isinstance(m, dict) and key in m]:
            other = f"set network.converters.NAME.{key}"
            if "converter" in options:
                other = f"name the converter that gets it with {options['converter']}"
            whose = ", ".join(map(str, owners))
            raise UserError(
                printable(f"{named} {overrides[key]}: does not replace the own {key} of {whose};"
                          f" {other}")
            )  # fmt: skip
    return found, names


def look_beside(content: Any, folder: Path) -> None:
    """Make the files that a scenario names absolute where they lie in the scenario's folder: laws,
    inner stages, converters and courses of the grid.

    Args:
        content: of the scenario's file, plain data that nobody has checked.
        folder: of the file.
    """
    for table, key in _files(content):
        file = table[key]
        if not isinstance(file, str) or "\0" in file:
            continue
        if key not in ("file", "trace", "start_from") and not file.endswith(".toml"):
            continue
        with contextlib.suppress(OSError):  # a name too long: the check of the file says so
            is_folder = key in ("trace", "start_from") and (folder / file).is_dir()
            if (folder / file).is_file() or is_folder:
                table[key] = str((folder / file).absolute())


def _files(content: Any) -> Iterator[tuple[Any, Any]]:
    """The places of a scenario's content that may name files, each as container and key."""

    def within(table: Any, *keys: str) -> Iterator[tuple[Any, Any]]:
        for key in keys if isinstance(table, dict) else ():
            value = table.get(key)
            if isinstance(value, list):
                yield from ((value, k) for k in range(len(value)))
            elif key in table:
                yield table, key

    yield from within(content, "start_from")
    for one in (content, *_inside(content, "network", "converters").values()):
        yield from within(one, "law", "inner", "ready_laws", "compare")
        yield from within(_inside(one, "plant"), "converter")
        yield from within(_inside(one, "link", "impairment"), "trace")
    events = content.get("events") if isinstance(content, dict) else None
    for event in events if isinstance(events, list) else ():
        yield from within(event, "file", "law")


def _inside(table: Any, *keys: str) -> dict[str, Any]:
    """The table at a path of content that nobody has checked; an empty one if there is none."""
    for key in keys:
        table = table.get(key) if isinstance(table, dict) else None
    return table if isinstance(table, dict) else {}


def check_scenario(
    content: dict[str, Any],
    where: str,
    overrides: Mapping[tuple[str | int, ...], str] = MappingProxyType({}),
) -> Scenario:
    """The scenario of a dict, with its laws and its plant tried out.

    Args:
        content: plain data.
        where: the file it comes from.
        overrides: what does not come from there, by its path: an option with its value.

    Raises:
        UserError: as ``load_scenario``.
    """

    def source(path: tuple[str | int, ...]) -> str:
        """Where the value at a path comes from; a table may come from several places."""
        for part, option in overrides.items():
            if path[: len(part)] == part:
                return option
        inside = [option for part, option in overrides.items() if part[: len(path)] == path]
        return " with ".join([where, ", ".join(inside)] if inside else [where])

    try:
        scenario = Scenario.model_validate(content)
    except ValidationError as problem:
        raise UserError("\n".join(lines(problem, Scenario, source, content))) from None
    wrong: list[str] = []
    if stage := _stage_mistakes(scenario.inner):
        ours = "" if ("inner",) in overrides else f"{where}: "
        raise UserError("\n".join(ours + line for line in stage))
    try:
        if scenario.counts is not None:
            named_counts(scenario.counts)
    except LawError as problem:
        ours = "" if ("counts",) in overrides else f"{where}: "
        raise UserError("\n".join(ours + line for line in problem.lines)) from None
    for member in scenario.each.values():
        key = "inner" if _stage_mistakes(member.inner) else "law"
        at = f"{where}: network.converters.{member.converter}.{key}: "
        wrong += [at + line for law in member.laws() for line in _law_mistakes(law, member)]
    for law in dict.fromkeys([*scenario.laws(), *scenario.compare]):
        ours = "" if law == scenario.law and ("law",) in overrides else f"{where}: "
        wrong += [ours + line for line in _law_mistakes(law, scenario)]
    if not wrong:  # what is exchanged follows from all laws
        each = [*scenario.each.values()] or [scenario]
        for member in each:
            for law in member.laws():
                wrong += [f"{where}: {line}" for line in _counts_mistakes(law, member)]
        wrong += [f"{where}: {line}" for line in _plant_controller_mistakes(scenario)]
    try:
        _try_plant(scenario)
    except UserError as problem:
        wrong.append(f"{source(('plant',))}: {problem}")
    if wrong:
        raise UserError("\n".join(map(printable, wrong)))
    return scenario


def _stage_mistakes(name: str | None) -> Sequence[str]:
    """What is wrong with an inner stage, if one is named."""
    try:
        if name is not None:
            named_inner(name)
    except LawError as problem:
        return problem.lines
    return ()


def _plant_controller_mistakes(scenario: Scenario) -> Iterator[str]:
    """What plant controllers send and no law takes."""
    if scenario.network is None:
        return
    for name, one in scenario.network.plant_controllers.items():
        members = one.converters or [*scenario.each]
        if not scenario.each.keys() >= {*members}:
            continue  # a neighbour takes P and Q
        own = [scenario.each[member] for member in members]
        files = [load_law(law, x.inner, x.counts) for x in own for law in x.laws()]
        laws = [law for file in files for law in file.laws]
        for reference in one.sent():
            if not any(law.takes(reference) for law in laws):
                names = ", ".join(sorted({law.name for law in laws}))
                yield (
                    f"network.plant_controllers.{name}: sends {reference}, which none of its laws"
                    f" takes: {names}"
                )


def _law_mistakes(law: str, scenario: Scenario) -> Sequence[str]:
    """What is wrong with a law, read or at the scenario's sampling time."""
    try:
        stages = load_law(law, scenario.inner, scenario.counts).laws
    except LawError as problem:
        return problem.lines
    try:
        for stage in stages:
            discretise(stage, scenario.T_s)
    except LawError as problem:
        return problem.within(f"law {law}").lines
    return ()


def _counts_mistakes(law: str, scenario: Scenario) -> Sequence[str]:
    """What is wrong with a law's measurement and modulation, if the scenario's laws have them."""
    try:
        if scenario.signal_set == COUNTS:
            for stage in load_law(law, scenario.inner, scenario.counts).laws:
                _check_counts(stage, scenario)
    except LawError as problem:
        return problem.within(f"law {law}").lines
    return ()


def _check_counts(law: BuiltLaw, scenario: Scenario) -> None:
    """Raise LawError if a law's timer does not fit the sampling time, or is not the plant's."""
    if law.counts is None:
        why = "missing, and other laws of the scenario have them; give the scenario counts"
        raise LawError("measure, modulate", why)
    top, bridge = law.counts.modulate.top(scenario.T_s), scenario.plant.bridge
    carriers = 1.0 if bridge.carrier_hz is None else bridge.carrier_hz * scenario.T_s
    theirs = bridge.timer_hz * scenario.T_s / max(1, round(carriers)) / 2
    fits = bridge.kind == "average" or carriers in (1.0, 2.0)  # else the plant refuses it
    if fits and top != round(theirs):
        raise LawError(
            "modulate",
            f"{top} counts in half a period of the carrier; plant.bridge has {theirs:g}:"
            " timer_hz and carriers must be those of the bridge",
        )


def plant_of(scenario: Scenario) -> Network:
    """The plant of a scenario: one converter, or those of its network. Raises ValueError: as
    ``make_plant`` and ``make_network``."""
    if scenario.network is None:
        options = scenario.plant
        options = options.with_seed(scenario.seed) if scenario.seed else options
        return make_plant(options, scenario.T_s)
    converters = {}
    for name, member in scenario.network.converters.items():
        options = scenario.each[name].plant
        options = options.with_seed(scenario.seed) if scenario.seed else options
        converters[name] = (options, member.node)
    return make_network(converters, scenario.T_s, scenario.plant.grid, scenario.network)


def _try_plant(scenario: Scenario) -> None:
    """Build the plant and try those of its events that not every plant can carry out."""
    plants = {"plant.": scenario.plant} | {
        f"network.converters.{name}.plant.": one.plant for name, one in scenario.each.items()
    }
    for of, options in plants.items():
        place = f"{of}converter = {options.converter!r}"
        if not options.converter.endswith(".toml"):
            try:
                load_converter(options.converter)
            except ValueError as problem:  # names key and value itself
                raise UserError(f"{of}{problem}") from None
            continue
        try:
            ConverterParameters.model_validate(read_toml(options.converter))
        except ValidationError as problem:
            wrong = lines(problem, ConverterParameters)
            raise UserError("; ".join(f"{place}: {line}" for line in wrong)) from None
        except ValueError as problem:
            raise UserError(f"{place}: {problem}") from None
    try:
        plant = plant_of(scenario)
    except ValueError as problem:
        raise UserError(str(problem)) from None
    if scenario.cores is not None and scenario.cores > (parts := len(find_places(plant.wiring))):
        raise UserError(
            f"cores = {scenario.cores}: at most {parts}: the network has {parts} part"
            f"{'s' * (parts > 1)} with converters; network.bergeron_lines cut it, where nothing"
            " else connects their ends"
        )
    for k, event in enumerate(scenario.events):
        if isinstance(event, PlantEvent):
            try:
                event.try_on(plant)
            except (UserError, ValueError) as problem:
                raise UserError(f"events.{k}: {problem}") from None


def scenario_toml(scenario: Scenario) -> str:
    """The resolved scenario as TOML; ``load_scenario`` reads it back to an equal one."""
    return toml_text(scenario.model_dump(mode="json", exclude_none=True))


def toml_text(content: dict[str, Any]) -> str:
    """Nested tables, lists of tables and plain values as TOML."""
    import tomlkit  # here: few commands write

    return tomlkit.dumps(content)


def write_scenario(folder: Path, scenario: Scenario) -> None:
    """Write ``scenario.toml`` into a run folder, with the files of its events in ``profiles``.
    Raises OSError: a file cannot be read or written."""
    events, taken = [], dict[str, str]()
    for k, event in enumerate(scenario.events):
        if (file := getattr(event, "file", None)) is not None:
            name = Path(file).name
            name = f"{k}-{name}" if taken.get(name, file) != file else name
            taken[name] = file
            copy = folder / "profiles" / name
            copy.parent.mkdir(exist_ok=True)
            if not (copy.exists() and copy.samefile(file)):
                shutil.copyfile(file, copy)
            event = event.model_copy(update={"file": f"profiles/{name}"})
        events.append(event)
    written = scenario.model_copy(update={"events": events})
    write_text(folder / "scenario.toml", scenario_toml(written))
