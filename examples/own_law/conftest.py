"""The law under test, on our lab's bench. Files are looked for from the folder of the test."""

import pytest


def pytest_addoption(parser):
    parser.addoption("--law", default="my-droop", help="law under test, a file of laws/")


@pytest.fixture
def law(pytestconfig):
    return f"../laws/{pytestconfig.getoption('law')}.toml"


@pytest.fixture
def lab(bench, law):
    """Our law at rest in our lab."""
    bench.start("../lab.toml", law=law)
    return bench
