"""Machines with their controls, and converters that follow the grid, of a dynamic data file of
PSS/E (.dyr)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from gfm_hil.api.dyr import number, records
from gfm_hil.core.errors import UserError, lines
from gfm_plant.components import COMPONENTS

_SHORT = 1e-3  # s; the shortest time constant at a sampling period of 0.1 ms
_CONSTANT = 1e12  # p.u./p.u.; the droop of a turbine whose power is constant
_MOST = 2.0  # p.u.; of set-points of P and Q
_HIGH = 99.0  # p.u.; a limit that never acts
_INFINITE = 1e6  # s; the inertia constant of an infinite bus

Numbers = dict[str, float]
#: keys of a table, none if the record is left out, and what is otherwise than in it
Made = tuple[dict[str, Any], list[str]]


class Machines(NamedTuple):
    """What a file says of the generators."""

    #: by table of a network, and by the name of the bus, keys of a part of that table
    tables: Mapping[str, Mapping[str, dict[str, Any]]]
    ignored: Sequence[str]  #: what it says and this has not, or has otherwise
    file: str = ""  #: its path


class _DyrRecord(NamedTuple):
    where: str  # file, line, model and bus
    content: dict[str, Any]


def read_machines(path: str | Path) -> Machines:
    """Read the records of machines, their exciters, governors and stabilisers, of REGCA1 with
    REECA1 or REECB1, and of REPCA1: those in ``MODELS``.

    Raises:
        UserError: the file cannot be read, has no machine, a record is none, or has a value that
            its part refuses; the message has the file, the line, the bus and the field.
    """
    buses: dict[str, dict[str, _DyrRecord]] = {}
    ignored: list[str] = []
    for line, fields in records(path):
        where = f"{path}, line {line}"
        if len(fields) < 3:
            raise UserError(f"{where}: must be a bus, a model in quotes, a machine and numbers")
        bus, model, texts = fields[0], fields[1].upper(), fields[3:]
        if model == "USRMDL" and len(texts) > 6:
            model, texts = texts[0].upper(), texts[7:]
        if model not in MODELS:
            ignored.append(f"{model} at bus {bus} is not known here and left out.")
            continue
        role, names, make = MODELS[model]
        if role in buses.setdefault(bus, {}):
            ignored.append(f"Of several machines at bus {bus} the first one stands for all.")
            continue
        if len(texts) != len(names):
            raise UserError(f"{where}: {model} has {len(names)} numbers, not {len(texts)}")
        numbers = {
            name: number(f"{where}, {name}", text)
            for name, text in zip(names, texts, strict=True)
            if name != "circuit"  # a text
        }
        content, notes = make(numbers)
        ignored += [f"{model} at bus {bus}: {note}." for note in notes]
        if content:
            buses[bus][role] = _DyrRecord(f"{where}: {model} at bus {bus}", content)
    tables: dict[str, dict[str, dict[str, Any]]] = {}
    for bus, parts in buses.items():
        for table, content in _parts(bus, parts, ignored):
            tables.setdefault(table, {})[bus] = content
    if not tables:
        raise UserError(f"{path}: no record of GENROU, GENROE, GENSAL, GENSAE, GENCLS or REGCA1")
    return Machines(tables, list(dict.fromkeys(ignored)), str(path))


def _parts(
    bus: str, records: Mapping[str, _DyrRecord], ignored: list[str]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """The table and the keys of each part that the records at a bus are; notes go to ``ignored``.
    Raises UserError: a value that its part refuses."""
    generators = [role for role in records if role in _TABLES]
    if not generators:
        ignored.append(f"The controls at bus {bus} are left out with their machine.")
        return
    role = "converter" if "converter" in generators else generators[0]
    others = len(generators) > 1
    if role == "converter" and others:  # the case says which of both it is
        machine = {name: one for name, one in records.items() if name not in _OF_CONVERTER}
        yield from _parts(bus, machine, ignored)
        records = {name: one for name, one in records.items() if name in _OF_CONVERTER}
    controls = {name: records[name] for name in _CONTROLS[role] if name in records}
    if role == "converter":
        if (park := records.get("plant")) is not None:
            _check("plant_controllers", park.content, park, {})
            yield "plant_controllers", park.content
    elif others:
        ignored.append(f"Of several machines at bus {bus} the first one stands for all.")
    if role != "converter" and not {"control", "plant"}.isdisjoint(records):
        ignored.append(f"The controls of a converter at bus {bus} are left out: it has no REGCA1.")
    if role == "classical" and any(name in records for name in _CONTROLS["machine"]):
        ignored.append(f"The controls at bus {bus} are left out: GENCLS takes none here.")
    if "pss" in controls and "avr" not in controls:
        ignored.append(f"The stabiliser at bus {bus} is left out with its exciter.")
        controls.pop("pss")
    content = dict(records[role].content)
    for name, one in controls.items():
        content |= one.content if role == "converter" else {name: one.content}
    _check(_TABLES[role], {"node": bus, "S": 1.0, "P": 0.0} | content, records[role], controls)
    yield _TABLES[role], content


def _check(
    table: str, content: dict[str, Any], own: _DyrRecord, controls: Mapping[str, _DyrRecord]
) -> None:
    """Raise UserError with the record from which a value comes that a part refuses."""
    kind = COMPONENTS[table]
    try:
        kind.model_validate(content)
    except ValidationError as problem:
        place, text = problem.errors()[0]["loc"], lines(problem, kind)[0]
        key = str(place[0]) if place else ""
        if key in controls:
            own, text = controls[key], text.removeprefix(key).lstrip(".: ")
        elif key not in own.content:
            own = next((one for one in controls.values() if key in one.content), own)
        raise UserError(f"{own.where}: {text}") from None


def _sexs(p: Numbers) -> Made:
    T_A = p.pop("T_A/T_B") * p["T_B"]
    return _lagging({"type": "SEXS", "T_R": 0.0, "T_A": T_A, **p}, "T_R", "T_B", "T_E")


def _rotating(type: str, p: Numbers) -> Made:
    p.pop("switch")
    content, notes = _lagging({"type": type, **p}, "T_R", "T_A", "T_E", "T_F")
    if p["E_1"] == 0.0 and p["S_E2"] > 0.0:  # no two points of it
        content["S_E1"] = content["S_E2"] = 0.0
        notes.append("its saturation has no first point and is left out")
    return content, notes


def _unlimited(p: Numbers) -> Made:
    """One whose limits follow no voltage: IEEET1, which has no lead and lag."""
    T_B, T_C = p.pop("T_B"), p.pop("T_C")
    content, notes = _rotating("IEEET1", p)
    return content, notes + ["its lead and lag are left out"] * (T_B > 0.0 and T_B != T_C)


def _esdc2a(p: Numbers) -> Made:
    notes = []
    if p["V_Rmax"] <= 0.0:  # PSS/E finds one that fits
        p["V_Rmax"] = _HIGH
        notes.append(f"V_Rmax = {_HIGH:g}: it names none")
    content, more = _rotating("EXDC2", p)
    return content, notes + more


def _ieeet2(p: Numbers) -> Made:
    """Its feedback has two lags, ours the sum of both."""
    p["T_F"] = p.pop("T_F1") + p.pop("T_F2")
    content, notes = _rotating("IEEET1", {"switch": 0.0, **p})
    return content, [*notes, f"its feedback has one lag, T_F = {p['T_F']:g} s"]


def _plain(type: str, lags: str, p: Numbers) -> Made:
    """A record that has the parameters of ours; ``lags`` are those that ours must have."""
    return _lagging({"type": type, **p}, *lags.split())


_exst1 = partial(_plain, "EXST1", "T_R T_A T_F")


def _esst1a(p: Numbers) -> Made:
    """EXST1 with limits of its regulator, a second lead and lag, and a limiter of its field."""
    notes = []
    if p["T_C1"] != p["T_B1"]:
        notes.append("its second lead and lag are left out")
    if p["V_Amax"] < p["V_Rmax"] or p["V_Amin"] > p["V_Rmin"]:
        notes.append("V_Amax and V_Amin are left out")
    if p["K_LR"] > 0.0:
        notes.append("its limiter of the field's current is left out")
    kept = ("T_R", "V_Imax", "V_Imin", "T_C", "T_B", "K_A", "T_A", "V_Rmax", "V_Rmin", "K_C", "K_F",
            "T_F")  # fmt: skip
    content, more = _exst1({name: p[name] for name in kept})
    return content, notes + more


def _scrx(p: Numbers) -> Made:
    """SEXS, or fed by the terminals EXST1, but for its gain, which follows their voltage."""
    by_terminals = p.pop("C_switch") == 0.0
    p.pop("rc/rfd")
    if not by_terminals:
        return _sexs(p)
    content, notes = _exst1({
        "T_R": 0.0, "V_Imax": _HIGH, "V_Imin": -_HIGH, "T_C": p["T_A/T_B"] * p["T_B"],
        "T_B": p["T_B"], "K_A": p["K"], "T_A": p["T_E"], "V_Rmax": p["E_max"],
        "V_Rmin": p["E_min"], "K_C": 0.0, "K_F": 0.0, "T_F": 1.0,
    })  # fmt: skip
    return content, [*notes, "its gain does not follow the voltage"]


def _ggov1(p: Numbers) -> Made:
    """Its limit by the acceleration would act below R_open, the rate of its valve, in a fall."""
    select, K_a, T_a, K_imw, T_eng, *_ = (
        p.pop(name)
        for name in ("R_select", "K_a", "T_a", "K_imw", "T_eng", "A_set", "R_up", "R_down")
    )
    parts = {"its limit by the acceleration": K_a and T_a, "K_imw": K_imw, "T_eng": T_eng,
             "D_m < 0": p["D_m"] < 0.0}  # fmt: skip
    notes = [f"{part} is left out" for part, acts in parts.items() if acts]
    if select != 1.0:
        notes.append(f"its droop is by the electric power, not by R_select = {select:g}")
    p["flag"], p["D_m"] = bool(p["flag"]), max(p["D_m"], 0.0)
    if p["T_rate"] == 0.0:  # that of the machine
        p.pop("T_rate")
    if p["T_dgov"] == 0.0:
        p["K_dgov"], p["T_dgov"] = 0.0, 1.0
    content, more = _plain("GGOV1", "T_pelec T_act T_b T_fload", p)
    return content, notes + more


def _ieeeg1(p: Numbers) -> Made:
    shafts = [p.pop(name) for name in ("bus", "machine", "K2", "K4", "K6", "K8")][2:]
    content, notes = _lagging({"type": "IEEEG1", **p}, "T3")
    if p["T1"] == 0.0 < p["T2"]:
        content["T2"] = 0.0
        notes.append("T2 is left out, for T1 = 0")
    return content, notes + ["its shaft of low pressure is left out"] * any(shafts)


def _wsieg1(p: Numbers) -> Made:
    more = [p.pop(name) for name in (*_CURVE, "block")]
    content, notes = _ieeeg1(p)
    return content, notes + ["its dead bands and its curve are left out"] * any(more)


def _stabiliser(p: Numbers) -> Made:
    """Its washout is K_S T5 s/(1 + T6 s), ours K_S T5 s/(1 + T5 s)."""
    notes = []
    if (mode := p.pop("mode")) not in (1.0, 2.0):
        return {}, [f"its input, mode {mode:g}, is no speed, and it is left out"]
    if mode == 2.0:
        notes.append("acts on the speed of the rotor here")
    more = [p.pop(name, 0.0) for name in ("bus", "A3", "A4", "A5", "A6", "V_CU", "V_CL")]
    if any(more[1:]):
        notes.append("A3 to A6, V_CU and V_CL are left out")
    lag = p["T6"] or _SHORT
    p["K_S"], p["T5"], p["T6"] = p["K_S"] * p["T5"] / lag, lag, 0.0
    return {"type": "PSS1A", **p}, notes


def _st2cut(p: Numbers) -> Made:
    """Of its inputs those of a speed."""
    notes = []
    for k, mode in (("1", p.pop("mode")), ("2", p.pop("mode2"))):
        if mode not in (1.0, 2.0):
            if mode and p[f"K{k}"]:
                notes.append(f"its input {k}, mode {mode:g}, is no speed, and is left out")
            p[f"K{k}"] = 0.0
        elif mode == 2.0:
            notes.append(f"its input {k} is the speed of the rotor here")
    if not (p["K1"] or p["K2"]) or not p["T3"]:
        return {}, [*notes, "K1 and K2, or T3, are 0, and it is left out"]
    if any([p.pop(name) for name in ("bus", "bus2", "V_CU", "V_CL")][2:]):
        notes.append("V_CU and V_CL are left out")
    content, more = _lagging({"type": "ST2CUT", **p}, "T4")
    return content, notes + more


def _regca1(p: Numbers) -> Made:
    content, notes = _lagging({"T_i": p["Tg"]}, "T_i")
    return content, [*notes, "a PLL and a lag Tg stand for it, without its logic by the voltage"]


def _reec(p: Numbers) -> Made:
    content, notes = _lagging({"I_max": p["Imax"], "k_V": p["Kqv"], "T_V": p["Trv"]}, "T_V")
    content["band"] = max(p["dbd2"], -p["dbd1"], 0.0)
    if p["dbd2"] != -p["dbd1"]:
        notes.append(f"dead band of {content['band']:g} on both sides")
    if p["PQFLAG"]:
        notes.append("reactive current comes first")
    return content, [*notes, "its loops and tables are left out, P and Q are as they are set"]


def _repca1(p: Numbers) -> Made:
    """Its line is named by the buses at its ends until the case says what it is called."""
    if not p["Fflag"]:
        p["Kpg"] = p["Kig"] = 0.0
    if not (p["Kp"] or p["Ki"] or p["Kpg"] or p["Kig"]):
        return {}, ["its gains are 0, and it is left out"]
    start, end = (f"{p[name]:.0f}" for name in ("from", "to"))
    content, notes = _lagging({"T_fv": p["Tfv"]}, *(["T_fv"] if p["Tft"] else []))
    content |= {
        "line": f"{start}-{end}", "node": start, "control": "V" if p["RefFlag"] else "Q",
        "sends": "Q_ref", "period_s": _SHORT, "delay_s": 0.0, "T_fltr": p["Tfltr"], "T_p": p["Tp"],
        "K_p": p["Kp"], "K_i": p["Ki"], "V_frz": p["Vfrz"], "K_pg": p["Kpg"], "K_ig": p["Kig"],
        "T_ft": p["Tft"], "T_g": p["Tg"], "D_dn": p["Ddn"], "D_up": p["Dup"],
        "fe_max": p["femax"], "fe_min": p["femin"],
    }  # fmt: skip
    content |= {"R_c": p["Rc"], "X_c": p["Xc"]} if p["VCFlag"] else {"K_c": p["Kc"]}
    for band, low, high in (("dbd", "dbd1", "dbd2"), ("fdbd", "fdbd1", "fdbd2")):
        content[band] = max(p[high], -p[low], 0.0)
        if p[high] != -p[low]:
            notes.append(f"{band} = {content[band]:g} on both sides")
    content["e_max"] = max(p["emax"], -p["emin"])
    if p["emax"] != -p["emin"]:
        notes.append(f"e_max = {content['e_max']:g} on both sides")
    for name in ("P_max", "P_min", "Q_max", "Q_min"):
        content[name] = min(max(p[name.replace("_", "")], -_MOST), _MOST)
    if p["remote"] not in (0.0, p["from"]):
        notes.append("it measures the voltage where its line begins, not at its remote bus")
    return content, notes


def _lagging(content: dict[str, Any], *lags: str) -> Made:
    """With time constants that are as long as ours must be."""
    short = [name for name in lags if 0.0 <= content[name] < _SHORT]
    notes = [f"{name} = {_SHORT:g} s instead of {content[name]:g}" for name in short]
    return content | dict.fromkeys(short, _SHORT), notes


def _genrou(p: Numbers) -> Made:
    return _lagging({**p}, "T_d10", "T_d20", "T_q10", "T_q20")


def _gensal(p: Numbers) -> Made:
    """With X_q' = X_q the machine of order 6 has one damper in its q axis."""
    poles = {"X_q1": p["X_q"], "saturates_by": "E_q1"}
    return _lagging({**p, **poles}, "T_d10", "T_d20", "T_q20")


def _exponential(make: Callable[[Numbers], Made], p: Numbers) -> Made:
    content, notes = make(p)
    if p["S_12"]:
        notes.append("a parabola saturates it, through the same two points")
    return content, notes


def _gencls(p: Numbers) -> Made:
    notes = []
    if p["H"] == 0.0:
        p["H"] = _INFINITE
        notes.append(f"H = {_INFINITE:g} s instead of 0, an infinite bus")
    return {**p, "droop": _CONSTANT}, notes


#: the table of a network by what its generator is
_TABLES = {
    "machine": "synchronous_machines",
    "classical": "machines",
    "converter": "grid_following",
}
#: which controls each has
_CONTROLS = {"machine": ("avr", "governor", "pss"), "classical": (), "converter": ("control",)}
_OF_CONVERTER = ("converter", "control", "plant")
_REEC = ("Vdip", "Vup", "Trv", "dbd1", "dbd2", "Kqv", "Iqh1", "Iql1", "Vref0")
_LOOPS = ("Tp", "Q_max", "Q_min", "V_max", "V_min", "Kqp", "Kqi", "Kvp", "Kvi")
_POWER = ("Tiq", "dP_max", "dP_min", "P_max", "P_min", "Imax", "Tpord")
_SATURATION = ("switch", "E_1", "S_E1", "E_2", "S_E2")
_ROUND = ("T_d10", "T_d20", "T_q10", "T_q20", "H", "D", "X_d", "X_q", "X_d1", "X_q1", "X_2", "X_l",
          "S_10", "S_12")  # fmt: skip
_SALIENT = ("T_d10", "T_d20", "T_q20", "H", "D", "X_d", "X_q", "X_d1", "X_2", "X_l", "S_10", "S_12")
_COMMUTATOR = ("T_R", "K_A", "T_A", "T_B", "T_C", "V_Rmax", "V_Rmin", "K_E", "T_E", "K_F", "T_F",
               *_SATURATION)  # fmt: skip
_STEAM = ("bus", "machine", "K", "T1", "T2", "T3", "U_o", "U_c", "P_max", "P_min", "T4", "K1", "K2",
          "T5", "K3", "K4", "T6", "K5", "K6", "T7", "K7", "K8")  # fmt: skip
_CURVE = ("db1", "err", "db2", *(f"{x}{k}" for k in range(1, 6) for x in ("GV", "PGV")))
_LEADS = ("T1", "T2", "T3", "T4", "T5", "T6", "K_S", "V_STmax", "V_STmin", "V_CU", "V_CL")
#: by model: which part of a machine it is, its numbers in the order of a record, and what makes it
MODELS: dict[str, tuple[str, tuple[str, ...], Callable[[Numbers], Made]]] = {
    "GENROU": ("machine", _ROUND, _genrou),
    "GENROE": ("machine", _ROUND, partial(_exponential, _genrou)),
    "GENSAL": ("machine", _SALIENT, _gensal),
    "GENSAE": ("machine", _SALIENT, partial(_exponential, _gensal)),
    "GENCLS": ("classical", ("H", "D"), _gencls),
    "REGCA1": (
        "converter",
        ("Lvplsw", "Tg", "Rrpwr", "Brkpt", "Zerox", "Lvpl1", "Volim", "Lvpnt1", "Lvpnt0", "Iolim",
         "Tfltr", "Khv", "Iqrmax", "Iqrmin", "Accel"),
        _regca1,
    ),
    "REECA1": (
        "control",
        ("bus", "PFFLAG", "VFLAG", "QFLAG", "PFLAG", "PQFLAG", *_REEC, "Iqfrz", "Thld", "Thld2",
         *_LOOPS, "Vbias", *_POWER, *(f"{x}{k}" for x in ("Vq", "Vp") for k in range(8))),
        _reec,
    ),
    "REECB1": (
        "control",
        ("bus", "PFFLAG", "VFLAG", "QFLAG", "PQFLAG", *_REEC, *_LOOPS, *_POWER),
        _reec,
    ),
    "REPCA1": (
        "plant",
        ("remote", "from", "to", "circuit", "VCFlag", "RefFlag", "Fflag", "Tfltr", "Kp", "Ki",
         "Tft", "Tfv", "Vfrz", "Rc", "Xc", "Kc", "emax", "emin", "dbd1", "dbd2", "Qmax", "Qmin",
         "Kpg", "Kig", "Tp", "fdbd1", "fdbd2", "femax", "femin", "Pmax", "Pmin", "Tg", "Ddn",
         "Dup"),
        _repca1,
    ),
    "SEXS": ("avr", ("T_A/T_B", "T_B", "K", "T_E", "E_min", "E_max"), _sexs),
    "IEEET1": (
        "avr",
        ("T_R", "K_A", "T_A", "V_Rmax", "V_Rmin", "K_E", "T_E", "K_F", "T_F", *_SATURATION),
        partial(_rotating, "IEEET1"),
    ),
    "IEEET2": (
        "avr",
        ("T_R", "K_A", "T_A", "V_Rmax", "V_Rmin", "K_E", "T_E", "K_F", "T_F1", "T_F2",
         *_SATURATION[1:]),
        _ieeet2,
    ),
    "EXDC1": ("avr", _COMMUTATOR, _unlimited),
    "ESDC1A": ("avr", _COMMUTATOR, _unlimited),
    "IEEEX1": ("avr", _COMMUTATOR, _unlimited),
    "EXDC2": ("avr", _COMMUTATOR, partial(_rotating, "EXDC2")),
    "ESDC2A": ("avr", _COMMUTATOR, _esdc2a),
    "SCRX": ("avr", ("T_A/T_B", "T_B", "K", "T_E", "E_min", "E_max", "C_switch", "rc/rfd"), _scrx),
    "ESST1A": (
        "avr",
        ("UEL", "VOS", "T_R", "V_Imax", "V_Imin", "T_C", "T_B", "T_C1", "T_B1", "K_A", "T_A",
         "V_Amax", "V_Amin", "V_Rmax", "V_Rmin", "K_C", "K_F", "T_F", "K_LR", "I_LR"),
        _esst1a,
    ),
    "EXST1": (
        "avr",
        ("T_R", "V_Imax", "V_Imin", "T_C", "T_B", "K_A", "T_A", "V_Rmax", "V_Rmin", "K_C", "K_F",
         "T_F"),
        _exst1,
    ),
    "ESST3A": (
        "avr",
        ("T_R", "V_Imax", "V_Imin", "K_M", "T_C", "T_B", "K_A", "T_A", "V_Rmax", "V_Rmin", "K_G",
         "K_P", "K_I", "V_Bmax", "K_C", "X_L", "V_Gmax", "theta_P", "T_M", "V_Mmax", "V_Mmin"),
        partial(_plain, "ESST3A", "T_R T_M"),
    ),
    "ESST4B": (
        "avr",
        ("T_R", "K_PR", "K_IR", "V_Rmax", "V_Rmin", "T_A", "K_PM", "K_IM", "V_Mmax", "V_Mmin",
         "K_G", "K_P", "K_I", "V_Bmax", "K_C", "X_L", "theta_P"),
        partial(_plain, "ESST4B", "T_R"),
    ),
    "IEEEG1": ("governor", _STEAM, _ieeeg1),
    "WSIEG1": ("governor", (*_STEAM, *_CURVE, "block"), _wsieg1),
    "HYGOV": (
        "governor",
        ("R", "r", "T_r", "T_f", "T_g", "VELM", "G_max", "G_min", "T_W", "A_t", "D_turb", "q_NL"),
        partial(_plain, "HYGOV", "T_r T_f T_g T_W"),
    ),
    "GAST": (
        "governor",
        ("R", "T1", "T2", "T3", "A_T", "K_T", "V_max", "V_min", "D_turb"),
        partial(_plain, "GAST", "T1 T2 T3"),
    ),
    "GGOV1": (
        "governor",
        ("R_select", "flag", "R", "T_pelec", "maxerr", "minerr", "K_pgov", "K_igov", "K_dgov",
         "T_dgov", "V_max", "V_min", "T_act", "K_turb", "W_fnl", "T_b", "T_c", "T_eng", "T_fload",
         "K_pload", "K_iload", "L_dref", "D_m", "R_open", "R_close", "K_imw", "A_set", "K_a", "T_a",
         "T_rate", "db", "T_sa", "T_sb", "R_up", "R_down"),
        _ggov1,
    ),
    "TGOV1": (
        "governor",
        ("R", "T1", "V_max", "V_min", "T2", "T3", "D_t"),
        partial(_plain, "TGOV1", "T1 T3"),
    ),
    "PSS1A": ("pss", ("mode", "bus", "A1", "A2", *_LEADS), _stabiliser),
    "IEEEST": ("pss", ("mode", "bus", "A1", "A2", "A3", "A4", "A5", "A6", *_LEADS), _stabiliser),
    "ST2CUT": (
        "pss",
        ("mode", "bus", "mode2", "bus2", "K1", "K2", *(f"T{k}" for k in range(1, 11)), "L_Smax",
         "L_Smin", "V_CU", "V_CL"),
        _st2cut,
    ),
}  # fmt: skip
