"""The table "attack → before → now": each attack is a test, the table shows their results.

A test names its attack by ``@pytest.mark.attack(item, attack, before)`` and reports what it
measured through the fixture ``attack_now``::

    @pytest.mark.attack("1.2", "a plant whose tick stands still", "RUNNING for ever")
    def test_frozen(attack_now): ...
        attack_now("SAFE after 12 ticks")

``python -m pytest tests -m attack --attack-table docs/tables/attacks.md`` runs all of them and
writes the table.
"""

from collections.abc import Callable
from pathlib import Path

import pytest

_ATTACK, _NOW = "attack", "attack_now"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--attack-table", metavar="FILE", help="write the table of attacks to FILE")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "attack(item, attack, before): one row of the attack table")


def pytest_runtest_setup(item: pytest.Item) -> None:
    for marker in item.iter_markers(_ATTACK):
        item.user_properties.append((_ATTACK, marker.args))


@pytest.fixture
def attack_now(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Report in a few words the attack's present effect, with the figures this test measured."""

    def say(now: str) -> None:
        request.node.user_properties.append((_NOW, now))

    return say


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Write the table once all tests have ended."""
    path = config.getoption("--attack-table")
    if path is None:
        return
    rows = set()
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, []):
            if report.when == "call" or outcome == "error":
                now = "; ".join(value for key, value in report.user_properties if key == _NOW)
                now = now or "refused" if outcome == "passed" else "**the test fails**"
                test = report.nodeid.split("[")[0].rsplit("/", 1)[-1]
                for key, value in report.user_properties:
                    if key == _ATTACK:
                        number, attack, before = value
                        row = f"| {number} | {attack} | {before} | {now} | `{test}` |\n"
                        rows.add((tuple(int(part) for part in number.split(".")), row))
    head = "| item | attack | before | now | test |\n|---|---|---|---|---|\n"
    table = head + "".join(row for _, row in sorted(rows))
    Path(path).write_text(table, encoding="utf-8")
    terminalreporter.write_line(f"{len(rows)} attacks: {path}")
