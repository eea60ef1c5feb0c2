"""The catalogue against the paper: Table II, Section IV-A and the statements of Section II-C."""

import itertools

import numpy as np
import pytest

from gfm_runtime import (
    BuiltLaw,
    LawError,
    discretise,
    get_law,
    law_file,
    law_names,
    load_law,
    realise,
)
from gfm_runtime.elements import IF, PD, Element, P, union
from gfm_runtime.lawfile import ElementSpec
from gfm_runtime.signals import NU, NY, REF_NAMES

from ..support.files import text_of
from ..support.laws import LAWS, REF, Running

# Table II: name, then the fifteen cells phi_11 to phi_35; {} acts on the feedback only.
TABLE_II = text_of("table_ii.txt")
ROWS = {line.split()[0]: line for line in TABLE_II.strip().splitlines()}
DEPLOYABLE, RIG = "mimo-gfm-deployable", "mimo-gfm-deployable-rig"
PRACTICAL, THROUGH = "mimo-gfm-practical", "mimo-gfm-ride-through"
BESIDE = (
    *("mimo-gfm", "mimo-gfm-scheduled", DEPLOYABLE, RIG, PRACTICAL, THROUGH),
    *("dvoc", "hybrid-angle", "psc-dc"),
)

# Orders counted by hand: one for the DC PI, then row 2, then row 3.
ORDERS = {
    "droop-1": 1, "droop-2": 1 + 1, "droop-3": 1 + 1, "droop-4": 1 + 1, "droop-5": 1 + 1,
    "psc-1": 1, "psc-2": 1 + 1 + 1, "psc-3": 1 + 1 + 1,
    "vsg-1": 1 + 1 + 1, "vsg-2": 1 + 1 + 1, "vsg-3": 1 + 1, "vsg-4": 1 + 1, "vsg-5": 1 + 1 + 1,
    "vsg-6": 1 + 1 + 1, "vsg-7": 1 + 2 + 1, "vsg-8": 1 + 1 + 1, "vsg-9": 1 + 1,
    "vsg-10": 1 + 2 + 1, "vsg-11": 1 + 3 + 1, "vsg-12": 1 + 3 + 1,
    "matching-1": 1, "matching-2": 0,
    "mimo-gfm": 1 + 1 + 1, "mimo-gfm-scheduled": 1 + 1 + 1, DEPLOYABLE: 1 + 1 + 1, RIG: 1 + 1 + 1,
    PRACTICAL: 1 + 1 + 1, THROUGH: 1 + 1 + 1,
    "dvoc": 1 + 1, "hybrid-angle": 1 + 1, "psc-dc": 1,
}  # fmt: skip


def kinds(specs: list[ElementSpec] | None) -> list[str]:
    return sorted(s.type for s in specs) if specs else []


def in_table(cell: str) -> tuple[list[str], list[str]]:
    """Kinds of a cell of Table II, on the error and on the feedback only."""
    error, _, feedback = cell.strip("}").partition("{")
    return (
        [] if error == "0" else sorted(error.split("*")),
        sorted(feedback.split("*")) if feedback else [],
    )


def test_the_catalogue_is_table_ii_and_what_the_text_names():
    known, where = {*ROWS, *BESIDE}, "of tests/runtime/test_laws.py"
    assert not (new := {*law_names()} - known), f"enter {new} in ROWS or BESIDE {where}"
    assert not (new := known - {*ORDERS}), f"enter the number of states of {new} in ORDERS {where}"
    assert known == {*law_names()}
    assert law_names().index("vsg-2") < law_names().index("vsg-10"), "natural order"


@pytest.mark.parametrize("name", ROWS)
def test_elements_are_those_of_table_ii(name):
    file, law = law_file(name), get_law(name)
    cells = ROWS[name].replace("|", " ").split()[1:]
    for (i, j), cell in zip(itertools.product(range(NU), range(NY)), cells, strict=True):
        key = f"{i + 1}{j + 1}"
        phi, psi = in_table(cell)
        if name == "vsg-2" and phi == ["PI"] and i == 2:
            spec = file.phi[key][0]
            assert spec.type == "I" and spec.k_i, "printed without its proportional part"
            phi = ["I"]
        assert kinds(file.phi.get(key)) == phi, key
        assert kinds(file.psi.get(key)) == psi, key
        assert law.element("phi", (i, j)).is_zero == (not phi)
        assert law.element("psi", (i, j)).is_zero == (not psi)


def test_every_cell_of_a_law_is_in_force():
    """The printed MIMO-GFM has zeros where Eq. (36) has an element; no other law has."""
    for name, law in LAWS.items():
        zero = {c for cells in (law.phi, law.psi) for c, e in cells.items() if e.is_zero}
        own = name.partition("[")[0]
        printed = own.startswith("mimo-gfm") and own not in (DEPLOYABLE, RIG, PRACTICAL, THROUGH)
        assert zero == ({(1, 3), (1, 4), (2, 1)} if printed else set())


def test_if_and_o_are_shared_where_the_table_marks_them():
    """IF_1 of VSG-10 and O of VSG-11 and VSG-12 are the same on the error and on the feedback."""
    for name in ("vsg-10", "vsg-11", "vsg-12"):
        law = get_law(name)
        assert set(law.phi[1, 1].den) <= set(law.psi[1, 1].den)


def test_psc_2_psc_3_and_vsg_8_share_the_frequency_control():
    rows = {}
    for name in ("psc-2", "psc-3", "vsg-8"):
        file = law_file(name)
        assert kinds(file.phi["22"]) == ["IF", "PD"]
        rows[name] = get_law(name, D_p=0.02, T=0.3, T_z=0.04)
    for law in rows.values():
        assert law.phi[1, 1] == IF(0.02, 0.3) * PD(1.0, 0.04)
        assert {c for c in law.phi if c[0] == 1} == {(1, 1)}
        assert not law.psi


@pytest.mark.parametrize("omega", [0.1, 3.0, 100 * np.pi, 1e4])
def test_printed_mimo_gfm(omega):
    """Section IV-A, number by number."""
    s = 1j * omega
    printed = [
        [120.224 + 265.6217 / s, -0.0019, 0, 0.1673, -0.8274],
        [-0.8382, 0.017622 / (s + 1.7622), 0, 0, 0],
        [-4.8977, 0, 0, 1.0844 / s, 21.6872 / s],
    ]
    np.testing.assert_allclose(get_law("mimo-gfm")(s), printed, rtol=1e-13)
    np.testing.assert_allclose(load_law("mimo-gfm-scheduled").laws[0](s), printed, rtol=1e-13)


@pytest.mark.parametrize("omega", [0.1, 3.0, 100 * np.pi, 1e4])
def test_printed_vsg_2(omega):
    s = 1j * omega
    printed = [
        [90 + 400 / s, 0, 0, 0, 0],
        [0, 0.059801 / (s + 5.9801), 0, 0, 0],
        [0, 0, 0, 1.9048 / s, 38.0954 / s],
    ]
    np.testing.assert_allclose(get_law("vsg-2")(s), printed, rtol=1e-13)


def test_printed_structure_constraints():
    """Eq. (33) to (35): phi_24 = D_q phi_25 and phi_34 = D_q phi_35, to the four digits printed."""
    law = get_law("mimo-gfm", k_24=0.3)
    assert law.phi[1, 3](1j) == pytest.approx(0.05 * law.phi[1, 4](1j))
    assert law.phi[2, 3](1j) == pytest.approx(0.05 * law.phi[2, 4](1j), rel=1e-4)


@pytest.mark.parametrize("name", [name for name, law in LAWS.items() if law.name in ORDERS])
def test_number_of_states(name):
    law = LAWS[name]
    assert realise(law).order == discretise(law, 1e-4).order == ORDERS[law.name]


def loewner_rank(law: BuiltLaw) -> int:
    """McMillan degree from values alone: the rank of the Loewner matrix of samples.

    Independent of any realisation: only the elements' values are used.
    """

    def both(s: float) -> np.ndarray:
        rows = [
            [law.element("phi", (i, j))(s).real for j in range(NY)]
            + [law.element("psi", (i, j))(s).real for j in range(NY)]
            for i in range(NU)
        ]
        return np.array(rows)

    # row by row, since gains of 100 and of 0.001 need different tolerances
    total = 0
    left, right = np.geomspace(0.7, 900.0, 7), np.geomspace(1.1, 1400.0, 7)
    for i in range(NU):
        L = np.block(
            [[(both(b) - both(a))[[i]] / (b - a) * np.sqrt(a * b) for a in right] for b in left]
        )
        values = np.linalg.svd(L, compute_uv=False)
        total += int(np.sum(values > 1e-9 * values[0])) if values[0] > 0 else 0
    return total


@pytest.mark.parametrize("name", LAWS)
def test_order_is_the_mcmillan_degree(name):
    law = LAWS[name]
    assert loewner_rank(law) == realise(law).order


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("s", [0.5 + 0j, 1j, 30j, 3000j, -0.2 + 4j])
def test_realisation_has_the_elements_values(name, s):
    law = LAWS[name]
    from_r, from_y = realise(law)(s)
    phi = np.array([[law.element("phi", (i, j))(s) for j in range(NY)] for i in range(NU)])
    psi = np.array([[law.element("psi", (i, j))(s) for j in range(NY)] for i in range(NU)])
    np.testing.assert_allclose(from_r, phi, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(from_y, -phi - psi, rtol=1e-9, atol=1e-12)


def cascade(T: float) -> BuiltLaw:
    """A law whose row 2 has three factors five decades apart."""
    slow, fast = IF(1.0, 1e4 * T), IF(1.0, T / 10)
    return BuiltLaw("cascade", "", "", {(1, 1): P(2.0) * slow * IF(1.0, T) * fast})


@pytest.mark.parametrize("T", [1e-3, 1.0])
def test_spread_time_constants_stay_accurate(T):
    law = cascade(T)
    for s in (1e-5j / T, 1j / T, 100j / T):
        assert realise(law)(s)[0][1, 1] == pytest.approx(law.phi[1, 1](s), rel=1e-8)


def answer(name: str, column: int, on_reference: bool, ticks: int = 4000) -> np.ndarray:
    """omega_u - 1 after a unit step of one reference or one measurement, at 0.1 ms."""
    lag = {"T": 0.2} if name == "droop-5" else {"k_22": 5.0}
    loop = Running.of(discretise(get_law(name, D_p=0.01, **lag), 1e-4))
    ref, y = REF.copy(), REF.copy()
    loop.settle(60_000)  # until the washout of droop-5 has decayed
    (ref if on_reference else y)[column] += 1.0
    loop.unlimited()
    return np.array([loop.step(ref, y)[1] for _ in range(ticks)]) - 1.0


def test_droop_5_is_vsg_2_from_p_and_not_from_p_ref():
    """Section II-C: equal for a disturbance at the output side, not at the input side."""
    t = (np.arange(4000) + 0.5) * 1e-4  # Tustin sees a step in the middle of its first interval
    lag = 0.01 * (1 - np.exp(-t / 0.2))
    for name in ("droop-5", "vsg-2"):
        np.testing.assert_allclose(answer(name, 1, on_reference=False), -lag, atol=1e-9)
    np.testing.assert_allclose(answer("vsg-2", 1, on_reference=True), lag, atol=1e-9)
    np.testing.assert_allclose(answer("droop-5", 1, on_reference=True), 0.01, rtol=1e-9)


@pytest.mark.parametrize("name", LAWS)
def test_a_law_takes_the_references_that_move_what_it_commands(name):
    law, y = LAWS[name], REF + np.array([0.01, -0.02, 0.0, 0.03, -0.01])
    loop = discretise(law, 1e-4)

    def u(ref):
        return Running.of(loop).unlimited().settle(3, ref, y)

    for k, reference in enumerate(REF_NAMES):
        moved = (u(REF + 0.01 * (np.arange(NY) == k)) != u(REF)).any()
        followed = reference in law.u_0  # by u_0, which is not of the step
        assert law.takes(reference) == (moved or followed)


@pytest.mark.parametrize(("name", "start"), [("mimo-gfm-scheduled", 0), (THROUGH, 1)])
def test_a_scheduled_law_has_its_stages_in_order(name, start):
    laws = load_law(name)
    assert laws.schedule is not None and len(laws.laws) == len(laws.schedule.stages) >= 2
    assert laws.schedule.ends == sorted(laws.schedule.ends)
    assert get_law(name) == laws.laws[start]


def test_unknown_law_lists_the_known():
    with pytest.raises(LawError, match=r"law 'vsg-13': unknown; .*'vsg-12'"):
        load_law("vsg-13")


def test_unknown_parameter_lists_the_known():
    with pytest.raises(LawError, match=r"parameter H: unknown to vsg-2; known: \['D_p'"):
        load_law("vsg-2", H=3.0)


@pytest.mark.parametrize("name", LAWS)
def test_every_parameter_has_a_source(name):
    for parameter in LAWS[name].parameters.values():
        assert parameter.source and np.isfinite(parameter.value)


def test_laws_are_plain_data():
    assert isinstance(get_law("vsg-1").phi[1, 1], Element)
    assert union([e.den for e in get_law("mimo-gfm").phi.values()])
