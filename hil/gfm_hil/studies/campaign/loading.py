"""Reading a campaign file, and checking all of it before anything starts."""

import copy
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.core.schema import validate
from gfm_hil.scenario import check_scenario, find_file, load_scenario, plant_of, toml_text
from gfm_hil.studies.campaign.spec import Campaign, CampaignFile, put
from gfm_runtime import law_titles
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import parse_toml, read_text

# what a campaign decides itself; [set] may fix the last two
_OWN = ("law", "seed", "mode", "link", "compare", "duration", "T_s")
_SETTABLE = ("duration", "T_s")
_TRIED = 2000  # runs, about a millisecond each; a later one that cannot be ends the campaign

Tell = Callable[[int, int], None]


def find_campaign(name: str) -> Path:
    """The file of a campaign: a path, or the name of a shipped one. Raises UserError: neither
    exists."""
    return find_file("campaign", name, "campaigns/*.toml")


def load_campaign(
    given: str | Path | dict[str, Any],
    laws: Mapping[str, str] = MappingProxyType({}),
    changes: Mapping[str, Any] = MappingProxyType({}),
    tell: Tell = lambda done, of: None,
) -> Campaign:
    """Read and check a campaign, its runs included. Raises UserError: one line a mistake, each with
    its path, the value and what is allowed.

    Args:
        given: path or shipped name, or the content of a file. The stem of the file is the
            campaign's name, and the scenario and the law files may lie beside it.
        laws: in place of those of the file: law files by name.
        changes: keys of the file with other values.
        tell: told the checks done and how many there are, as they go on; there may be thousands.
    """
    path, text, content = Path("campaign"), None, given
    if not isinstance(content, dict):
        path = find_campaign(os.fspath(content))
        try:
            text = read_text(path)
            content = parse_toml(text)
        except ValueError as problem:
            raise UserError(f"{path}: {problem}") from None
    if changes or laws:
        text, content = None, {**content, **changes} | ({"laws": [*laws]} if laws else {})
    file = validate(path, CampaignFile, content)
    if text is None:
        text = toml_text(content)
    base = load_scenario(_beside(path, file.scenario), in_process=True)
    known = base.converters
    if (file.converter not in known) if known else (file.converter is not None):
        must = f"must be one of {known}" if known else "the scenario has no network"
        raise UserError(f"{path}: converter = {file.converter!r}: {must}")
    content = base.model_dump(mode="json")
    content.update(compare=[], expect="completed", expect_reason=None, expect_after=None)
    _check_paths(path, file, content)
    for target, value in file.set.items():
        put(content, target, value)
    files = {law: laws.get(law) or _beside(path, law) for law in file.laws}
    titles = law_titles(files.values())
    file = file.model_copy(update={"laws": [titles[law] for law in files.values()]})
    campaign = Campaign(path.stem, text, file, content, {titles[f]: f for f in files.values()})
    for label, law in files.items():
        under = campaign.under(content, titles[law])
        check_scenario(under, f"{path}: law {label} on {file.scenario}")
    ends = [(k, d, end) for k, d in enumerate(campaign.file.draw) for end in d.ends()]
    runs = range(min(campaign.file.runs, _TRIED))
    for done, (k, d, end) in enumerate(ends):
        tell(done, len(ends) + len(runs))
        # every distribution's extremes, one at a time, on the scenario as it is
        content = copy.deepcopy(campaign.base)
        for target in d.paths():
            put(content, target, end)
        check_scenario(content, f"{path}: draw.{k}, {d.path} = {end!r}")
    for run in runs:
        tell(len(ends) + run, len(ends) + len(runs))
        _check_run(path, campaign, run)
    return campaign


def _beside(path: Path, name: str) -> str:
    """A file that lies beside the campaign's, or the name as it is."""
    beside = path.parent / name
    with suppress(OSError):  # a name too long, which its loader refuses
        return str(beside.resolve()) if beside.is_file() else name
    return name


def _check_paths(path: Path, file: CampaignFile, content: dict[str, Any]) -> None:
    """See that every path exists, is the campaign's to change and is given once."""
    where = [(f"set.{p}", p) for p in file.set]
    where += [(f"draw.{k}", p) for k, d in enumerate(file.draw) for p in d.paths()]
    problems, seen = [], set()
    for entry, target in where:
        own = target.split(".")[0]
        if target == f"network.converters.{file.converter}.law":
            own = "law"
        if own in _OWN and not (entry.startswith("set.") and own in _SETTABLE):
            problems.append(f"{entry}: {target!r} is the campaign's own and cannot be set here")
        elif target in seen:
            problems.append(f"{entry}: {target!r} is given twice")
        else:
            seen.add(target)
            try:
                put(copy.deepcopy(content), target, 0)
            except KeyError as problem:
                problems.append(f"{entry}: {problem.args[0]}")
    if len(set(file.laws)) < len(file.laws):
        problems.append(f"laws = {file.laws}: each once")
    if problems:
        raise UserError("\n".join(f"{path}: {printable(p)}" for p in problems))


def _check_run(path: Path, campaign: Campaign, run: int) -> None:
    """Make a run's plant: what fails only in combination shows before anything starts."""
    law = campaign.file.laws[0]
    try:
        scenario, _ = campaign.scenario(run, law)
        plant_of(scenario)
    except ValueError:
        check_scenario(campaign.under(campaign.drawn(run)[0], law), f"{path}: run {run}")
        raise
