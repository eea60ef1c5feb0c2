"""The SunSpec device with a simulated run and clock: the effect of writes, in every order."""

import asyncio
import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.constants import ExcCodes

from gfm_hil.ports.modbus.device import TICK_S
from gfm_hil.ports.modbus.grid_forming import NUMBER
from gfm_hil.ports.modbus.image import BASE, VENDOR
from gfm_runtime.states import SAFE

from ...support.modbus_device import S_N, Bench


def test_every_point_reads_back_what_was_put_into_it():
    image = Bench().device.image
    for point in image.points.values():
        if point.name in ("ID", "L") or point.type in ("sunssf", "pad"):
            continue
        low, high = (-3e6, 3e6) if point.type.startswith("float") else point.limits()
        exact = 10.0**point.exponent
        values = ["ab", None] if point.type == "string" else [low * exact, high * exact, None]
        for value in values:
            image.set(point.path, value)
            expected = pytest.approx(value) if isinstance(value, float) else value
            assert image.get(point.path) == expected


def test_what_clients_may_write_the_standard_lets_them_write():
    device = Bench().device
    ours = [p for p in device.image.points.values() if device.writable(p)]
    assert all(p.standard_access == "RW" for p in ours)
    written = {int(p.path.partition(".")[0]) for p in ours}
    assert written == {704, 705, 711, 715, VENDOR, NUMBER}


@pytest.mark.parametrize("before", [None, 1000.0, 3600.0])
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_value_mode_and_enable_take_effect_together_in_any_order(order, before):
    bench = Bench()
    if before is not None:  # an earlier client's values must not come back
        assert bench.write(("704.WSetPct", 100 * before / S_N)) is None
        assert bench.write(("704.WSetMod", 0)) is None
        assert bench.write(("704.WSetEna", 1)) is None
        assert bench.write(("704.WSetEna", 0)) is None
    bench.told.clear()
    steps = [("704.WSetEna", 1), ("704.WSetMod", 1), ("704.WSet", 3000.0)]
    for k in order:
        assert bench.write(steps[k]) is None
    assert {e["P_ref"] for e in bench.told} == {0.75}  # never another value
    assert bench.read("704.WSet") == 3000.0 and bench.read("704.WSetPct") == 75.0


def test_one_request_is_one_command():
    bench = Bench()
    assert bench.write(("704.WSetEna", 1), ("704.WSetMod", 1), ("704.WSet", 3000.0)) is None
    assert bench.told == [{"type": "reference", "P_ref": 0.75}]


def test_disabling_goes_back_to_what_was_in_force_before():
    bench = Bench()
    for step in (("704.VarSet", 400.0), ("704.VarSetEna", 1)):
        assert bench.write(step) is None
    assert bench.row["ref_Q_ref"] == 0.1
    assert bench.write(("704.VarSetEna", 0)) is None
    assert bench.row["ref_Q_ref"] == 0.0
    assert bench.read("704.VarSet") == 0.0  # forgotten: enabling again changes nothing
    assert bench.write(("704.VarSetEna", 1)) is None
    assert bench.row["ref_Q_ref"] == 0.0


@pytest.mark.parametrize(
    ("back", "P_ref", "enabled"),
    [((), 0.5, 0), ((("704.WSetRvrt", 800.0), ("704.WSetEnaRvrt", 1)), 0.2, 1)],
)
def test_the_timer_takes_the_set_point_back(back, P_ref, enabled):
    bench = Bench()
    for step in (*back, ("704.WSetRvrtTms", 2), ("704.WSetEna", 1), ("704.WSet", 3000.0)):
        assert bench.write(step) is None
    bench.pass_by(1.5)
    assert bench.read("704.WSetRvrtRem") == 1
    assert bench.write(("704.WSet", 3200.0)) is None  # the timer restarts
    bench.pass_by(1.9)
    assert bench.P_ref == 0.8
    bench.pass_by(0.2)
    assert (bench.P_ref, bench.read("704.WSetEna")) == (P_ref, enabled)
    assert bench.read("704.WSetRvrtRem") == 0
    told = len(bench.told)
    bench.pass_by(5.0)
    assert len(bench.told) == told  # once


@settings(deadline=None, max_examples=40)
@given(timeout_ms=st.integers(100, 3000), at=st.floats(0.0, 5.0))
def test_a_heartbeat_expires_within_one_tick_of_its_setting(timeout_ms, at):
    bench = Bench()
    assert bench.write((f"{VENDOR}.HbTms", timeout_ms)) is None
    for step in (("704.WSetEna", 1), ("704.WSet", 3000.0)):
        assert bench.write(step) is None
    bench.pass_by(at)
    bench.now = max(at, bench.now)  # between two ticks of the clock
    beat = bench.now
    assert bench.write(("715.ControllerHb", 7)) is None
    while bench.P_ref == 0.75:
        assert bench.now < beat + 4.0
        bench.pass_by(TICK_S)
    assert -1e-9 <= bench.now - beat - timeout_ms * 1e-3 <= TICK_S + 1e-9
    assert bench.P_ref == 0.5 and bench.read("704.WSetEna") == 0
    assert bench.read(f"{VENDOR}.HbLost") == 1
    assert bench.read("701.MnAlrmInfo") == "heartbeat of the client lost"
    bench.pass_by(2 * timeout_ms * 1e-3)
    assert bench.read(f"{VENDOR}.HbLost") == 1  # until the heartbeat returns
    assert bench.write(("715.ControllerHb", 8)) is None
    assert bench.read("701.MnAlrmInfo") is None


def test_a_heartbeat_must_change_and_one_that_never_began_is_not_missed():
    bench = Bench(heartbeat_ms=500)
    assert bench.write(("704.WSet", 3000.0)) is None
    assert bench.write(("704.WSetEna", 1)) is None
    bench.pass_by(3.0)
    assert bench.P_ref == 0.75
    for beat in (1, 2, 3, 3):
        assert bench.write(("715.ControllerHb", beat)) is None
        bench.pass_by(0.3)
    assert bench.P_ref == 0.5


def curve(bench: Bench, D_q: float, v_ref: float) -> list[tuple[str, float]]:
    a, b = 100 - 100 * D_q, 100 + 100 * D_q
    points = (("Pt1.V", a), ("Pt1.Var", 100.0), ("Pt2.V", b), ("Pt2.Var", -100.0))
    return [(f"705.Crv2.{n}", v) for n, v in (("ActPt", 2), ("VRef", 100 * v_ref), *points)]


@pytest.mark.parametrize("enable_first", [False, True])
def test_a_curve_is_voltage_reference_and_droop(enable_first):
    bench = Bench()
    for step in curve(bench, 0.08, 1.02):
        assert bench.write(step) is None
    assert bench.told == []
    steps = [("705.AdptCrvReq", 2), ("705.Ena", 1)]
    for step in steps[::-1] if enable_first else steps:
        assert bench.write(step) is None
    assert bench.row["ref_V_ref"] == pytest.approx(1.02)
    assert bench.gains["D_q"] == pytest.approx(0.08)
    assert bench.read("705.Crv1.VRef") == 102.0 and bench.read("705.Crv1.Pt1.V") == 92.0
    assert bench.read(f"{VENDOR}.Dq") == pytest.approx(0.08)
    assert bench.write(("705.Ena", 0)) is None
    assert bench.row["ref_V_ref"] == 1.0 and bench.gains["D_q"] == pytest.approx(0.05)


def test_a_droop_control_is_D_p():
    bench = Bench()
    assert bench.read("711.Ctl1.KOf") == pytest.approx(0.01)
    for step in (("711.Ctl2.KOf", 0.02), ("711.Ctl2.KUf", 0.02), ("711.Ena", 1)):
        assert bench.write(step) is None
    assert bench.told == []
    assert bench.write(("711.AdptCtlReq", 2)) is None
    assert bench.gains == {"D_p": pytest.approx(0.02)}
    assert bench.read("711.AdptCtlRslt") == 1


def test_the_draft_for_grid_forming_commands_in_watts_volts_and_hertz():
    bench = Bench()
    bench.row |= {"true_delta": math.pi / 6, "u_E_u": 1.0, "ref_omega_g": 1.0}
    for name, value in (("WSet", 3000), ("VarSet", -400), ("VRef", 224.0), ("HzRef", 50.1)):
        assert bench.write((f"{NUMBER}.{name}", value)) is None
    assert bench.write((f"{NUMBER}.DroopP", 0.02), (f"{NUMBER}.DroopQ", 0.08)) is None
    told = {name: x for event in bench.told for name, x in event.items() if name != "type"}
    gains = {name: pytest.approx(x) for name, x in told.pop("values").items()}
    assert told == pytest.approx(
        {"P_ref": 0.75, "Q_ref": -0.1, "V_ref": 224 * math.sqrt(3) / 380, "omega_g": 1.002}
    )
    assert gains == {"D_p": 0.02, "D_q": 0.08}
    seen = {name: bench.read(f"{NUMBER}.{name}") for name in ("WSet", "PRef", "HzRef", "DroopQ")}
    assert seen == pytest.approx({"WSet": 3000, "PRef": 3000, "HzRef": 50.1, "DroopQ": 0.08})
    # vsg-2: phi_22 = D_p/(s/5.9801 + 1)
    seen = {name: bench.read(f"{NUMBER}.{name}") for name in ("InertiaH", "ThetaInv", "EInv")}
    expected = {"InertiaH": 1 / (2 * 0.02 * 5.9801), "ThetaInv": 30.0, "EInv": 380 / math.sqrt(3)}
    assert seen == pytest.approx(expected, rel=1e-4)
    assert bench.read(f"{NUMBER}.GridSt") == 7 and bench.read(f"{NUMBER}.BSEna") is None
    bench.law, bench.gains = "mimo-gfm", {}  # where v_dc acts on omega_u too
    assert bench.read(f"{NUMBER}.InertiaH") is None
    bench.row["state"] = float(SAFE)
    assert bench.read(f"{NUMBER}.GridSt") == 8


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ([("704.WSet", 1e5)], ExcCodes.ILLEGAL_VALUE),
        ([("704.WSetEna", 2)], ExcCodes.ILLEGAL_VALUE),
        ([("704.VarSetMod", 2)], ExcCodes.ILLEGAL_VALUE),
        ([("704.WSet", None)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.Law", 4)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.Law", 0)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.VRef", 3.0)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.VRef", float("inf"))], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.Dp", -0.01)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.Dp", float("inf"))], ExcCodes.ILLEGAL_VALUE),
        ([(f"{VENDOR}.HbTms", 5)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{NUMBER}.WSet", 1e5)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{NUMBER}.DroopP", -0.01)], ExcCodes.ILLEGAL_VALUE),
        ([(f"{NUMBER}.InertiaH", 2.0)], ExcCodes.ILLEGAL_ADDRESS),
        ([("705.AdptCrvReq", 3)], ExcCodes.ILLEGAL_VALUE),
        ([("715.OpCtl", 2)], ExcCodes.ILLEGAL_VALUE),
        ([("715.AlarmReset", 7)], ExcCodes.ILLEGAL_VALUE),
        ([("701.W", 100.0)], ExcCodes.ILLEGAL_ADDRESS),
        ([("702.WMax", 100.0)], ExcCodes.ILLEGAL_ADDRESS),
        ([("704.WSetRvrtTms", 3), ("704.WSetRvrtRem", 3)], ExcCodes.ILLEGAL_ADDRESS),
        ([("715.DERHb", 3)], ExcCodes.ILLEGAL_ADDRESS),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(request_, code):
    bench = Bench()
    bench.device.refresh()
    before = list(bench.device.image.registers)
    assert bench.write(*request_) == code
    bench.device.refresh()
    why = bench.device.image.points[f"{VENDOR}.Refd"]
    after = list(bench.device.image.registers)
    assert bench.read(f"{VENDOR}.Refd") is not None
    first = why.address - BASE
    after[first : first + why.length] = before[first : first + why.length]
    assert (after, bench.told) == (before, [])


def test_a_refused_curve_says_so_and_nothing_else_changes():
    bench = Bench()
    off = [("Pt1.V", 96.0), ("Pt1.Var", 100.0), ("Pt2.V", 105.0), ("Pt2.Var", -100.0)]
    for name, value in (("ActPt", 2), ("VRef", 100.0), *off):
        assert bench.write((f"705.Crv2.{name}", value)) is None
    assert bench.write(("705.Ena", 1)) is None
    assert bench.write(("705.AdptCrvReq", 2)) == ExcCodes.ILLEGAL_VALUE
    assert bench.read("705.AdptCrvRslt") == 2 and bench.told == []


def test_a_law_without_a_droop_shows_none_and_takes_none():
    bench = Bench()
    assert bench.write((f"{VENDOR}.Law", 3)) is None
    assert bench.law == "droop-1"
    assert bench.read(f"{VENDOR}.Dq") is None and bench.read("705.Crv1.Pt1.V") is None
    assert bench.write((f"{VENDOR}.Dq", 0.1)) == ExcCodes.ILLEGAL_VALUE
    assert "droop-1 has no D_q" in bench.read(f"{VENDOR}.Refd")
    assert bench.write(("705.Crv2.VRef", 101.0)) is None  # ActPt is 0: V_ref alone
    assert bench.write(("705.AdptCrvReq", 2)) is None
    assert bench.write(("705.Ena", 1)) is None
    assert bench.row["ref_V_ref"] == pytest.approx(1.01) and bench.gains == {}


def test_a_run_that_refuses_leaves_everything_as_it_is():
    bench = Bench()
    assert bench.write(("704.WSet", 3000.0)) is None
    bench.deaf = True
    assert bench.write(("704.WSetEna", 1)) == ExcCodes.DEVICE_FAILURE
    assert bench.read("704.WSetEna") == 0
    assert bench.read(f"{VENDOR}.Refd") == "the controller does not answer"


@pytest.mark.parametrize("what", [("704.WSetRvrtTms", 1), ("715.ControllerHb", 1)])
def test_what_expires_and_cannot_be_carried_out_is_tried_again(what):
    bench = Bench(heartbeat_ms=1000)
    for step in (("704.WSetEna", 1), what, ("704.WSet", 3000.0)):
        assert bench.write(step) is None
    bench.deaf = True
    bench.pass_by(1.5)
    assert bench.P_ref == 0.75
    bench.deaf = False
    bench.pass_by(TICK_S)
    assert bench.P_ref == 0.5


@pytest.mark.parametrize("how", [("715.AlarmReset", 1), ("715.OpCtl", 1)])
def test_reset_from_a_trip_and_from_nothing(how):
    bench = Bench()
    assert bench.write(how) is None and bench.told == []  # nothing to reset
    for step in (("704.WSetRvrtTms", 1), ("704.WSetEna", 1), ("704.WSet", 3000.0)):
        assert bench.write(step) is None
    bench.row |= {"true_trip": 1.0, "state": float(SAFE)}
    assert bench.read("701.InvSt") == 6 and bench.read("701.Alrm") == 1 << 16
    assert bench.read("715.OpCtl") == 0 and bench.read(f"{VENDOR}.SafeRsn") == "over-current"
    assert bench.write(how) is None
    assert bench.told[-1] == {"type": "reset"}
    assert bench.read("701.InvSt") == 3 and bench.read("704.WSetEna") == 0
    told = len(bench.told)
    bench.pass_by(3.0)
    assert len(bench.told) == told  # earlier commands are forgotten


def test_stop():
    bench = Bench()
    assert bench.write(("715.OpCtl", 0)) is None
    assert bench.told == [{"type": "stop"}]


def test_local_control_refuses_all_but_heartbeats_and_takes_nothing_back():
    bench = Bench()
    for step in (("704.WSetRvrtTms", 1), ("704.WSetEna", 1), ("704.WSet", 3000.0)):
        assert bench.write(step) is None
    bench.device.take(local=True)
    assert bench.read("715.LocRemCtl") == 1
    assert bench.write(("704.WSet", 1000.0)) == ExcCodes.ILLEGAL_FUNCTION
    assert bench.write(("715.ControllerHb", 1)) is None
    bench.pass_by(3.0)
    assert bench.P_ref == 0.75
    bench.device.take(local=False)
    assert bench.write(("704.WSetEna", 1)) is None


def test_no_write_cuts_a_point_in_two():
    bench = Bench()
    at = bench.device.image.points["704.WSet"].address
    for first, registers in ((at, [1]), (at + 1, [1]), (at - 1, [1, 0])):
        found = asyncio.run(bench.device.access(first, registers))
        assert found == ExcCodes.ILLEGAL_ADDRESS
    assert bench.told == []
