"""The H-infinity problem in pictures: its weights, its six channels, and what bounds gamma."""

from __future__ import annotations

import numpy as np
from _figures.common import FIGURES, GREY, dress
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from gfm_design.norms.performance import PAPER_WEIGHTS, StateSpace, Weight, WeightedChannel
from gfm_design.tuning.full_order import full_order
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.paper import PAPER_START, PaperProblem, tune_paper
from gfm_design.tuning.synthesis import Tuned
from gfm_hil.results.figures import COLOURS
from gfm_runtime import law_file

LAW = "mimo-gfm"
SIGNALS = (("P_{ref} - p", "p", r"\omega_u", "q + V/D_q"), ("P_{ref}", r"\omega_g"))
OMEGA = np.logspace(-4, 5.5, 6000)


def problem(weights: tuple[Weight, ...] = PAPER_WEIGHTS, paper_start: bool = True) -> PaperProblem:
    """The paper's problem, or one with other weights, from the paper's initial K."""
    file = law_file(LAW)
    gains = free_gains(file, PAPER_START[LAW] if paper_start else None)
    return PaperProblem(file, gains, weights=weights)


def printed() -> PaperProblem:
    """The problem at the printed gains: the gains' starts are these."""
    return problem(paper_start=False)


def starts(of: PaperProblem) -> NDArray[np.float64]:
    """What the gains start from."""
    return np.array([g.start for g in of.gains])


def weights() -> None:
    """|W_ij| over the frequency."""
    figure = Figure(figsize=(7.6, 4.6), layout="constrained")
    axes = figure.subplots()
    places = {  # where a curve is named: rad/s, offset in points
        (1, 1): (2e-2, (6, 6)), (2, 1): (9e3, (-34, 4)), (2, 2): (2e-2, (0, 5)),
        (3, 1): (2e1, (8, -6)), (3, 2): (9e3, (-2, -14)), (4, 1): (1e-1, (8, 6)),
    }  # fmt: skip
    for weight, colour in zip(PAPER_WEIGHTS, COLOURS, strict=False):
        size = np.abs(weight(1j * OMEGA))
        axes.loglog(OMEGA, size, color=colour, lw=1.6)
        at, offset = places[weight.i, weight.j]
        axes.annotate(
            f"$W_{{{weight.i}{weight.j}}}$", (at, float(np.interp(at, OMEGA, size))), offset,
            textcoords="offset points", color=colour, fontsize=11,
        )  # fmt: skip
    axes.set_xlim(1e-4, 1e5)
    axes.set_ylim(3e-3, 3e6)
    axes.set_xlabel("ω [rad/s]", fontsize=9)
    dress(axes, "|W_ij(jω)|")
    figure.savefig(FIGURES / "design_weights.png", dpi=110)


def _size(loop: StateSpace, weight: Weight, omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """|T_ij| at omega."""
    A, B, C, D = loop
    b, c = B[:, [weight.j - 1]].astype(complex), C[weight.i - 1]
    inner = np.linalg.solve(1j * omega[:, None, None] * np.eye(len(A)) - A, b)
    return np.asarray(np.abs(c @ inner[..., 0].T + D[weight.i - 1, weight.j - 1]))


def _omega(loop: StateSpace) -> NDArray[np.float64]:
    """Frequencies that miss no resonance of the loop."""
    poles = np.linalg.eigvals(loop[0])
    near = np.abs(poles.imag[:, None] + np.linspace(-4, 4, 41) * poles.real[:, None]).ravel()
    return np.unique(np.concatenate([OMEGA, near[near > OMEGA[0]]]))


def channels(found: Tuned) -> None:
    """|T_ij| of printed and tuned gains under 1/|W_ij|, one panel a channel."""
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True).ravel()
    cases = (
        ("printed gains", COLOURS[1], 2.6, printed(), None),
        ("tuned gains", COLOURS[0], 1.1, problem(), found),
    )
    for k, (a, weight) in enumerate(zip(axes, PAPER_WEIGHTS, strict=True)):
        bound = 1.0 / np.abs(weight(1j * OMEGA))
        tops = [bound]
        for name, colour, width, of, tuned in cases:
            values = starts(of) if tuned is None else tuned.values
            loop, norms = of.closed_loop(values).performance(), of.channels(values)
            omega = _omega(loop)
            size = _size(loop, weight, omega)
            a.loglog(omega, size, color=colour, lw=width, label=name)
            _peak(a, loop, weight, norms[k], colour, (-18, 7) if tuned is None else (6, -14))
            tops.append(size)
        a.fill_between(OMEGA, bound, 1e9, color=GREY, alpha=0.16, lw=0)
        a.loglog(OMEGA, bound, color="#444444", lw=1.0, label="1/|W_ij|: γ = 1")
        a.set_ylim(*_span(weight, bound, tops))
        a.set_xlim(1e-2, 1e5)
        z, w = SIGNALS[0][weight.i - 1], SIGNALS[1][weight.j - 1]
        dress(a, f"$T_{{{weight.i}{weight.j}}}$: ${w}$ to ${z}$")
        if (weight.i, weight.j) == (3, 1):
            _closer(a, (0.07, 0.09, 0.48, 0.4), (6600.0, 7600.0), (7e-7, 7e-6))
    for a in axes[3:]:
        a.set_xlabel("ω [rad/s]", fontsize=9)
    for a in axes[::3]:
        a.set_ylabel("|T| [p.u. per p.u.]", fontsize=9)
    axes[0].legend(fontsize=8.5, frameon=False, loc="lower right")
    figure.savefig(FIGURES / "design_channels.png", dpi=110)


def _closer(
    a: Axes,
    place: tuple[float, float, float, float],
    x: tuple[float, float],
    y: tuple[float, float],
) -> None:
    """The same lines in a window of their own, which spans x [rad/s] and y."""
    window = a.inset_axes(place)
    for line in a.get_lines():
        window.plot(*line.get_data(), color=line.get_color(), lw=line.get_linewidth(),
                    marker=line.get_marker(), ms=line.get_markersize())  # fmt: skip
    window.set(xlim=x, ylim=y, yscale="log", xticks=x, yticks=[])
    window.set_xticks([], minor=True)
    window.set_yticks([], minor=True)
    window.tick_params(labelsize=7.5, color=GREY)
    a.indicate_inset_zoom(window, edgecolor="#444444")


def _peak(
    a: Axes,
    loop: StateSpace,
    weight: Weight,
    norm: WeightedChannel,
    colour: str,
    beside: tuple[int, int],
) -> None:
    """Where W T is largest: the norm, and the place on |T|."""
    omega = max(norm.omega, 1e-1)  # a norm reached at rest stands at the left
    size = float(_size(loop, weight, np.array([omega]))[0])
    a.plot(omega, size, "o", color=colour, ms=4.5)
    a.annotate(
        f"{norm.norm:.2f}", (omega, size), beside, textcoords="offset points", color=colour,
        fontsize=9, path_effects=[withStroke(linewidth=2.5, foreground="white")],
    )  # fmt: skip


def _span(
    weight: Weight, bound: NDArray[np.float64], sizes: list[NDArray[np.float64]]
) -> tuple[float, float]:
    """Limits of |T|: six decades at most below what is to be seen."""
    high = 3.0 * max(float(s.max()) for s in sizes[1:])
    return max(high * 1e-6, 0.3 * float(bound[OMEGA > 1e-2].min())), high


def bound(found: Tuned) -> None:
    """What bounds gamma: any controller, one column at a time; this law, one weight left out."""
    of = problem()
    whole = full_order(of.linear, PAPER_WEIGHTS)
    assert whole is not None and None not in whole.columns, "the full-order solver ran out of time"
    w_32 = next(w for w in PAPER_WEIGHTS if (w.i, w.j) == (3, 2))
    alone = full_order(of.linear, (w_32,))
    assert alone is not None
    rows: list[tuple[str, float, str]] = [
        ("$W_{32} T_{32}$ alone: the bound", alone.bound, GREY),
        ("all of $\\omega_g$ as one stack", whole.columns[1] or np.nan, GREY),
        ("all of $P_{ref}$ as one stack", whole.columns[0] or np.nan, GREY),
    ]
    for left_out in PAPER_WEIGHTS:
        fewer = problem(tuple(w for w in PAPER_WEIGHTS if w is not left_out))
        cost = tune_paper(fewer).cost
        rows.append((f"MIMO-GFM tuned without $W_{{{left_out.i}{left_out.j}}}$", cost, COLOURS[5]))
    rows.append(("MIMO-GFM tuned", found.cost, COLOURS[0]))
    rows.append(("MIMO-GFM as printed", max(c.norm for c in printed().channels(starts(printed()))),
                 COLOURS[1]))  # fmt: skip
    figure = Figure(figsize=(7.6, 4.4), layout="constrained")
    axes = figure.subplots()
    for y, (_, value, colour) in enumerate(rows):
        axes.barh(-y, value, color=colour, height=0.7)
        axes.annotate(
            f"{value:.3f}", (value, -y), (4, -3.5), textcoords="offset points", fontsize=9
        )
    axes.set_yticks([-y for y in range(len(rows))], [label for label, *_ in rows])
    axes.axvline(1.0, color="#444444", lw=0.8, ls=(0, (4, 3)))
    axes.set_xlim(0, 2.3)
    axes.set_xlabel("γ", fontsize=9)
    dress(axes, "any controller at all (grey), and one law (blue, orange)")
    axes.grid(False, axis="y")
    figure.savefig(FIGURES / "design_bound.png", dpi=110)
