"""The signal table."""

from dataclasses import replace

import pytest

from gfm_runtime import signals
from gfm_runtime.signals import (
    D_NAMES,
    NU,
    NY,
    REF_NAMES,
    SIGNALS,
    U_NAMES,
    Y_NAMES,
    group,
    table_hash,
)


def test_vectors_in_the_papers_order():
    """Eq. (13) to (17)."""
    assert Y_NAMES == ("v_dc", "p", "omega_u", "q", "V")
    assert U_NAMES == ("i_u", "omega_u", "E_u")
    assert REF_NAMES == ("V_dcref", "P_ref", "omega_g", "Q_ref", "V_ref")
    assert D_NAMES == ("omega_g", "V_g")
    assert (len(Y_NAMES), len(U_NAMES), len(REF_NAMES)) == (NY, NU, NY)


@pytest.mark.parametrize("name", ["y", "u", "ref", "d"])
def test_names_are_unique_within_a_group(name):
    names = [s.name for s in group(name)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("signal", SIGNALS, ids=lambda s: f"{s.group}.{s.name}")
def test_each_row_makes_sense(signal):
    assert signal.low <= signal.default <= signal.high
    assert signal.scale > 0
    assert (signal.high - signal.low) / signal.scale < 2**16, "its counts fit 16 bit"
    assert signal.symbol and signal.unit and signal.base and signal.description


@pytest.mark.parametrize("change", [{"scale": 1e-3}, {"high": 9.0}, {"unit": "V"}, {"name": "x"}])
def test_hash_changes_with_the_table(change, monkeypatch):
    before = table_hash()
    assert len(before) == 8 and before == table_hash()
    monkeypatch.setattr(signals, "SIGNALS", (replace(SIGNALS[0], **change), *SIGNALS[1:]))
    assert table_hash() != before


def test_hash_changes_with_order_and_version(monkeypatch):
    hashes = {table_hash()}
    monkeypatch.setattr(signals, "SIGNALS", SIGNALS[::-1])
    hashes.add(table_hash())
    monkeypatch.setattr(signals, "TABLE_VERSION", signals.TABLE_VERSION + 1)
    hashes.add(table_hash())
    assert len(hashes) == 3
