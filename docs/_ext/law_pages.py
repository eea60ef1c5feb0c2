"""The law catalogue as Markdown, from the law files themselves."""

from __future__ import annotations

import ast
from functools import cache

import numpy as np

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import Mode
from gfm_hil.cli.laws import cell_text
from gfm_hil.core.terminal import markdown
from gfm_plant import Plant
from gfm_runtime import discretise, law_file, law_names, load_law
from gfm_runtime.lawfile import ElementSpec, LawFile, Number
from gfm_runtime.signals import REF_NAMES, U_NAMES, group

T_S = 1e-4
BANDWIDTH_HZ = 300.0
_GREEK = {"eta", "alpha", "gamma", "xi"}
_SYMBOL = {s.name: s.symbol for s in (*group("u"), *group("ref"))}
_ERRORS = {
    "linear": r"e = Y_{ref} - y",
    "dc-energy": r"e_1 = \tfrac12\bigl(V_{dcref}^2 - v_{dc}^2\bigr),"
    r"\quad e_j = Y_{ref,j} - y_j \text{ otherwise}",
    "dvoc": r"e_2 = \frac{P_{ref}}{V_{ref}^2} - \frac{p}{V^2},\quad "
    r"e_4 = \frac{Q_{ref}}{V_{ref}^2} - \frac{q}{V^2},\quad e_j = Y_{ref,j} - y_j"
    r" \text{ otherwise}",
    "hybrid-angle": r"e_2 = \sin\tfrac12(\delta_{ref} - \delta),\quad e_j = Y_{ref,j} - y_j"
    r" \text{ otherwise}",
}


def symbol(name: str) -> str:
    """A parameter's name as a formula writes it, e.g. k_{pdc}."""
    head, _, index = name.partition("_")
    head = f"\\{head}" if head in _GREEK else head
    return f"{head}_{{{index}}}" if index else head


def formula(value: Number) -> str:
    """A number or an expression of a law file in LaTeX; a quotient in one line."""
    return _latex(ast.parse(str(value), mode="eval").body)


def _time(value: Number) -> str:
    text = formula(value)
    return f"({text})" if "/" in text else text


def _latex(node: ast.expr) -> str:
    match node:
        case ast.Constant(value=int() | float() as number):
            return r"\omega_b" if abs(number - 100 * np.pi) < 1e-6 else f"{number:g}"
        case ast.Name(id=name):
            return symbol(name)
        case ast.UnaryOp(operand=operand):
            return f"-{_latex(operand)}"
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            return f"{_latex(left)}/{_latex(right)}"
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return rf"{_latex(left)}\,{_latex(right)}"
    raise ValueError(ast.unparse(node))


def _lag(T: Number) -> tuple[str, str]:
    """What 1/(T s + 1) is: (numerator, denominator); T = 1/k becomes k/(s + k)."""
    tree = ast.parse(str(T), mode="eval").body
    match tree:
        case ast.BinOp(left=ast.Constant(value=1), op=ast.Div(), right=ast.Name(id=name)):
            return symbol(name), f"s + {symbol(name)}"
    return "", f"{_time(T)}\\,s + 1"


def factor_formula(spec: ElementSpec) -> str:
    """One factor of an element in LaTeX."""
    k = "" if spec.k is None or spec.k == 1.0 else formula(spec.k)
    T = "" if spec.T is None or spec.T == 1.0 else _time(spec.T)
    match spec.type:
        case "P":
            text = k or "1"
        case "I" if spec.k_i is not None:
            text = rf"\dfrac{{{formula(spec.k_i)}}}{{s}}"
        case "I":
            text = rf"\dfrac{{1}}{{{T}\,s}}"
        case "D":
            text = rf"{T}\,s" if T else "s"
        case "PI" if spec.k_i is not None:
            text = rf"{formula(spec.k or 0.0)} + \dfrac{{{formula(spec.k_i)}}}{{s}}"
        case "PI":
            text = rf"{k}\Bigl(1 + \dfrac{{1}}{{{T}\,s}}\Bigr)"
        case "PD":
            text = rf"{k}(1 + {T}\,s)"
        case "IF":
            assert spec.T is not None
            top, bottom = _lag(spec.T)
            text = rf"\dfrac{{{' '.join(p for p in (k, top) if p) or '1'}}}{{{bottom}}}"
        case _:
            assert spec.xi is not None
            text = rf"\dfrac{{{k or '1'}}}{{{T}^2 s^2 + 2\,{T}\,{formula(spec.xi)}\,s + 1}}"
    return text if spec.T_f is None else rf"{text}\,\dfrac{{1}}{{{formula(spec.T_f)}\,s + 1}}"


def matrix(file: LawFile, which: str) -> str:
    """Phi(s) or Psi(s) of a law in LaTeX."""
    cells = file.phi if which == "phi" else file.psi
    rows = []
    for i in "123":
        row = []
        for j in "12345":
            spec = cells.get(i + j)
            factors = spec if isinstance(spec, list) else [spec] if spec else []
            row.append(r"\,".join(factor_formula(f) for f in factors) or "0")
        rows.append(" & ".join(row))
    name = r"\Phi(s)" if which == "phi" else r"\Psi(s)"
    body = r" \\[2ex] ".join(rows)
    return rf"{name} = \begin{{bmatrix}} {body} \end{{bmatrix}}"


def _plant(name: str, rig: bool) -> Plant:
    home = load_law(name).first.home_grid
    options: dict[str, object] = {"factors": {"L_g": home.L_g, "R_g": home.R_g}}
    if rig:
        options |= {"delay": {"samples": 1}, "sensors": {"bandwidth_hz": BANDWIDTH_HZ}}
    return Plant.model_validate(options)


@cache
def worst_mode(name: str, rig: bool) -> Mode:
    """The oscillation that lasts longest on the home grid, or a real mode that does not decay.

    Ideal, or with one sample of delay and 300 Hz sensors.
    """
    modes = ClosedLoop.of(name, _plant(name, rig)).modes()
    return next(m for m in modes if m.frequency_hz > 1e-3 or m.sigma >= 0.0)


def _mode_text(mode: Mode) -> str:
    text = f"{mode.sigma:.2f}".replace("-", "−")
    text = f"**+{text}**" if mode.sigma >= 0.0 else text
    f = mode.frequency_hz
    return f"{text} 1/s at {f:.3g} Hz" if f < 100 else f"{text} 1/s at {f:.0f} Hz"


def overview() -> str:
    """One row a law."""
    rows = []
    for name in law_names():
        file, law = law_file(name), load_law(name).first
        cells = "; ".join(
            f"{i}{j} {cell_text(file, i + j)}"
            for i in "123"
            for j in "12345"
            if cell_text(file, i + j) != "0"
        )
        home = law.home_grid
        rows.append([
            f"[{name}](#law-{name})", cells, str(discretise(law, T_S).order), law.error_map,
            "paper" if home.L_g == 1 else f"× {home.L_g:g}",
            *(_mode_text(worst_mode(name, rig)) for rig in (False, True)),
        ])  # fmt: skip
    heads = ("law", "elements", "states", "errors", "grid")
    return markdown([*heads, "slowest swing, ideal", "slowest swing, rig"], rows)


def _set_points(file: LawFile) -> str:
    def text(value: float | str) -> str:
        return _SYMBOL[value] if isinstance(value, str) else f"{value:g}"

    values = ",\\ ".join(text(getattr(file.u_0, n)) for n in U_NAMES)
    assert all(
        v in REF_NAMES for v in (getattr(file.u_0, n) for n in U_NAMES) if isinstance(v, str)
    )
    return f"$u_0 = ({values})$"


def _law(name: str) -> list[str]:
    file, laws = law_file(name), load_law(name)
    law, home = laws.first, laws.first.home_grid
    ideal, rig = worst_mode(name, False), worst_mode(name, True)
    lines = [f"(law-{name})=", f"#### {name}: {law.title}", "", " ".join(law.source.split()), ""]
    lines += ["$$", matrix(file, "phi"), "$$", ""]
    if file.psi:
        lines += ["On the feedback only:", "", "$$", matrix(file, "psi"), "$$", ""]
    elements = [
        [f"${u}$", *(cell_text(file, f"{i}{j}") for j in "12345")]
        for i, u in zip("123", ("i_u", "\\omega_u", "E_u"), strict=True)
    ]
    parameters = [
        [f"${symbol(key)}$ `{key}`", f"{p.value:.9g}", p.unit or "–", p.source]
        for key, p in law.parameters.items()
    ]
    lines += [
        markdown(["", "$v_{dc}$", "$p$", "$\\omega_u$", "$q$", "$V$"], elements),
        "",
        f"Errors: {law.error_map}"
        + (f", ${_ERRORS[law.error_map]}$" if law.error_map != "linear" else "")
        + f". Set-points {_set_points(file)}. States: {discretise(law, T_S).order}. "
        + f"Grid: {home.note}"
        + (f" ($L_g$ × {home.L_g:g}, $R_g$ × {home.R_g:g})" if home.L_g != 1 else "")
        + f". Least damped oscillation there: {_mode_text(ideal)} "
        + f"(damping ratio {ideal.ratio:.2g}); "
        + f"with one sample of delay and {BANDWIDTH_HZ:g} Hz sensors {_mode_text(rig)} "
        + f"({rig.ratio:.2g}).".replace("-", "−"),
        "",
        markdown(["parameter", "value", "unit", "source"], parameters),
    ]
    if laws.schedule is not None:
        by_V = laws.schedule.by_V
        of = "voltage $V$" if by_V else "estimated reactance $X$ of the grid"
        lines += ["", f"Stages, by the {of} [p.u.]:", ""]
        rows = []
        for k, stage in enumerate(laws.schedule.in_order):
            last = k == len(laws.schedule.stages) - 1
            changed = ", ".join(f"`{n}` = {v:g}" for n, v in stage.parameters.items())
            rows.append(("no end" if last else f"{stage.end:g}", changed or "none"))
        lines.append(
            markdown(("up to $V$" if by_V else "up to $X$", "parameters that differ"), rows)
        )
    return [*lines, ""]


def catalogue() -> str:
    """Every law in a section of its own."""
    return "\n".join(line for name in law_names() for line in _law(name))
