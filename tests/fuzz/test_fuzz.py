"""Every parser reads any input or refuses it as documented.

Hypothesis' profile sets the number of generated inputs, see CONTRIBUTING.md.
"""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .parsers_files import FILES
from .parsers_peers import PEERS
from .parsers_servers import SERVERS

readers = pytest.mark.parametrize(
    "reader", [*FILES, *PEERS, *SERVERS], ids=lambda parser: parser.name, indirect=True
)


@readers
@pytest.mark.attack(
    "11.2",
    "inputs near valid ones, for every parser",
    "57 of 200 inputs: a traceback, a wrong frame taken, or the end of the server",
)
def test_corpus(reader, attack_now):
    """Inputs that once broke a parser, or are likely to."""
    files, broken = reader.corpus(), []
    for file in files:
        try:
            reader.read(file.read_bytes())
        except Exception as problem:
            broken.append(f"{file.name}: {problem!r:.200}")
    assert files and not broken, "\n".join(broken)
    attack_now(f"{reader.parser.name}: {len(files)} inputs of the corpus are read or refused")


@readers
@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
def test_made_up_inputs(reader, data):
    reader.read(data.draw(reader.inputs))
