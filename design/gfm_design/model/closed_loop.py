"""The closed loop of a law and a plant, on which all analysis and synthesis works.

The loop is continuous, as the paper's (Section III), or the exact sampled one of the bench. Around
its operating point it maps w = (references r, grid d) to y as it truly is, before the sensors:

    x' = A x + B w,    y = C x + D w,    x = (plant, its delay lines, law, inner stage),

where x' is dx/dt or the x of the next tick. With an inner stage the loop has four commands, those
of the bridge, and eleven measurements; w and the y that it gives stay the same. Every other
quantity (modes, margins, gamma, step) follows from these matrices. A ``ClosedLoop`` may hold many
loops: plants, laws or both on leading axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import schur

from gfm_design.model.inner import LinearStage, linearise_stage
from gfm_design.model.linear import (
    LinearLaw,
    LinearPlant,
    Mode,
    delay_lines,
    hold,
    linearise_law,
    linearise_plant,
    sampled_plant,
)
from gfm_design.model.operating_point import OperatingPoint, operating_point
from gfm_design.norms.hinf import balance
from gfm_design.norms.performance import (
    D_Q,
    PAPER_WEIGHTS,
    StateSpace,
    Weight,
    WeightedChannel,
    channel_norms,
)
from gfm_plant import Plant, load_converter, make_plant
from gfm_plant.model import DELTA
from gfm_plant.parameters import Element
from gfm_plant.records import Record
from gfm_runtime.catalogue import get_law
from gfm_runtime.errors import LawError
from gfm_runtime.law import BuiltLaw
from gfm_runtime.realisation import realise
from gfm_runtime.signals import NY, REF_NAMES, U_NAMES, Y_NAMES, carried
from gfm_runtime.tustin import OMEGA_COLUMN, OMEGA_ROW, DiscreteLaw, discretise

if TYPE_CHECKING:
    from gfm_design.model.network import Surroundings

Matrix = NDArray[np.float64]
Response = NDArray[np.complex128]

T_S = 1e-4  # s
REFERENCES = (1.0, 0.5, 1.0, 0.0, 1.0)  # (V_dcref, P_ref, omega_g, Q_ref, V_ref), Table III
#: the loop's inputs w: the references, and the grid as Eq. (15) has it
INPUTS = (*REF_NAMES, "grid.omega_g", "grid.V_g")

#: every command and measurement that a loop may have; the last ones only with an inner stage
U_CARRIED, Y_CARRIED = carried("u", True), carried("y", True)

NOT_IDEAL = (
    "runs from tick to tick: the continuous loop has none; use the sampled one, or inner none"
)

#: distances from a resonance at which to look, as multiples of its damping
_ACROSS = np.concatenate([-np.logspace(1, -1.5, 8), [0.0], np.logspace(-1.5, 1, 8)])
GONE = 1e-9  # poles with a smaller |z| are those of the delay lines: z = 0 but for rounding
_P_REF, _OMEGA_G = INPUTS.index("P_ref"), INPUTS.index("grid.omega_g")
_V_C, _I_O = 2, 4  # where v_d and i_od are in the plant's state; v_q and i_oq follow
_P, _Q, _V = (Y_NAMES.index(name) for name in ("p", "q", "V"))


@dataclass(frozen=True)
class Origin:
    """What a loop was made of; ``ClosedLoop.changed`` makes it anew with other elements."""

    plant: Plant  #: its options
    law: DiscreteLaw  #: at its sampling time
    ideal: bool  #: the loop is continuous and has the law before it was discretised
    ref: Matrix  #: references, shape (5,), p.u.
    par: Record  #: the plant's record
    op: OperatingPoint  #: the operating point


class LinearLoop:
    """What the loop of one converter and that of a network have in common."""

    _what = "loop"
    T_s: float | None

    @cached_property
    def A(self) -> Matrix:
        """The loop's matrix, shape (..., n, n)."""
        raise NotImplementedError

    @cached_property
    def state_space(self) -> StateSpace:
        """(A, B, C, D) from the inputs to y, before the sensors."""
        raise NotImplementedError

    def sigma(self) -> Any:
        """Largest real part of any mode, 1/s: a number, or the shape of the leading axes.

        A sampled loop without any eigenvalue but 0 gives -inf.
        """
        values = np.linalg.eigvals(self.A)
        if self.T_s is None:
            return values.real.max(axis=-1)
        with np.errstate(divide="ignore"):
            return np.log(np.abs(values).max(axis=-1)) / self.T_s

    def poles(self) -> Response:
        """Poles of a single loop as s, 1/s; of a sampled one log(z)/T_s without delay lines."""
        values = np.linalg.eigvals(self.A).astype(complex)
        return values if self.T_s is None else np.log(values[np.abs(values) > GONE]) / self.T_s

    def _step(
        self, of: str, among: Sequence[str], seconds: float, every: float
    ) -> tuple[Matrix, Matrix]:
        """(t, y) after a unit step of one of the inputs.

        Raises:
            ValueError: no such input.
        """
        if of not in among:
            raise ValueError(f"{of!r} is no input of the {self._what}; use one of {list(among)}")
        A, B, C, D = self.state_space
        k, tick = among.index(of), self.T_s or every
        if self.T_s is None:
            A, B = hold(A, B, tick)
        t = np.asarray(tick * np.arange(round(seconds / tick) + 1), np.float64)
        x, y = np.zeros(len(A)), np.empty((len(t), len(C)))
        for row in y:
            row[:] = C @ x + D[:, k]
            x = A @ x + B[:, k]
        return t, y

    def _at(self, omega: ArrayLike) -> Response:
        """s, or z = e^(s T_s), on the imaginary axis."""
        s = 1j * np.asarray(omega, float)
        return s if self.T_s is None else np.exp(s * self.T_s)


class ClosedLoop(LinearLoop):
    """A law on a plant around one operating point.

    Args:
        plant: continuous, one or several on a leading axis.
        law: continuous if the loop is, else from tick to tick; one or several on a leading axis.
        T_s: sampling time, s; None for a continuous loop, which has no delay.
        u_delay: from the tick that samples y[k] to the moment when u[k] acts, s: a number, or shape
            (..., 3), with an inner stage (..., 4).
        y_delay: how old y is at its tick, s: a number, or shape (..., 5), with an inner stage
            (..., 11).
        origin: what it was made of, if known.
        stage: the inner stage between the law and the bridge, one or several on a leading axis.
        around: the other converters' controllers, if the converter is one of several; ``plant`` is
            then the network without any controller.

    Raises:
        ValueError: a continuous loop with a delay or an inner stage.
    """

    def __init__(
        self,
        plant: LinearPlant,
        law: LinearLaw,
        T_s: float | None = None,
        u_delay: ArrayLike = 0.0,
        y_delay: ArrayLike = 0.0,
        origin: Origin | None = None,
        stage: LinearStage | None = None,
        around: Surroundings | None = None,
    ) -> None:
        many, n_u, n_y = plant.A.shape[:-2], plant.B.shape[-1], plant.C.shape[-2]
        self.plant, self.law, self.T_s, self.origin = plant, law, T_s, origin
        self.stage, self.around = stage, around
        self.where = ""  #: title of the scenario, for figures
        self.u_delay: Matrix = np.broadcast_to(np.asarray(u_delay, float), (*many, n_u))
        self.y_delay: Matrix = np.broadcast_to(np.asarray(y_delay, float), (*many, n_y))
        if T_s is None and (self.u_delay.any() or self.y_delay.any()):
            raise ValueError("a continuous loop has no delay; sample it first")
        if T_s is None and stage is not None:
            raise ValueError("an inner stage runs from tick to tick; a continuous loop has none")

    @classmethod
    def of(
        cls,
        law: str | BuiltLaw | DiscreteLaw,
        plant: Plant | None = None,
        references: Sequence[float] | Matrix = REFERENCES,
        *,
        T_s: float = T_S,
        ideal: bool = False,
    ) -> Self:
        """The loop of a law on a plant, around their operating point.

        Args:
            law: catalogue name, path of a law file (of a scheduled law the stage in force at the
                start), a law, or one at its sampling time.
            plant: converter, delay, sensors, DC source, grid and factors of the elements, as in a
                scenario; by default the paper's converter, with neither delay nor sensors.
            references: (V_dcref, P_ref, omega_g, Q_ref, V_ref), p.u.
            T_s: sampling time, s; a law that has its own keeps it.
            ideal: the continuous loop, neither sampled nor delayed, whatever the plant says.

        Raises:
            LawError: no such law, or it cannot be discretised; ``ideal`` with an inner stage.
            NoEquilibrium: there is no operating point, or a limit of the inner stage acts there.
        """
        if not isinstance(law, DiscreteLaw):
            law = discretise(get_law(law) if isinstance(law, str) else law, T_s)
        plant = plant or Plant()
        ref = np.asarray(references, float)
        return cls._made(plant, law, ideal, ref, make_plant(plant, law.T_s).par)

    @classmethod
    def _made(cls, plant: Plant, law: DiscreteLaw, ideal: bool, ref: Matrix, par: Record) -> Self:
        grid, delay, inner = plant.grid, plant.delay, law.law.inner
        if ideal and inner is not None:
            raise LawError("inner", NOT_IDEAL)
        op = operating_point(par, law, ref, grid.omega_g, grid.V_g)
        around = grid.omega_g, grid.V_g, grid.finite, inner is not None
        linear = linearise_plant(par, op, *around)
        controlled = plant.dc_source.mode == "controlled"
        state_space = realise(law.law) if ideal else law
        reaction = linearise_law(law.law, state_space, op, ref, controlled)
        origin = Origin(plant, law, ideal, ref, par, op)
        if ideal:
            return cls(linear, reaction, origin=origin)
        seconds = (delay.samples + delay.fraction) * law.T_s
        stage = linearise_stage(inner, law.T_s, float(par[0]["omega_b"]), op) if inner else None
        return cls(linear, reaction, law.T_s, seconds, origin=origin, stage=stage)

    @classmethod
    def stacked(cls, loops: Sequence[ClosedLoop]) -> Self:
        """Single loops of one sampling time, whose sampled plants have one size, as many plants.

        The law is that of the first; ``with_law`` gives all of them another. Either all have an
        inner stage or none has.
        """
        plants = LinearPlant.stacked([loop.plant for loop in loops])
        u_delay, y_delay = (
            np.stack([getattr(o, n) for o in loops]) for n in ("u_delay", "y_delay")
        )
        stages = [loop.stage for loop in loops if loop.stage is not None]
        stage = LinearStage.stacked(stages) if stages else None
        out = cls(plants, loops[0].law, loops[0].T_s, u_delay, y_delay, stage=stage)
        out.__dict__["held"] = LinearPlant.stacked([loop.held for loop in loops])
        return out

    def __repr__(self) -> str:
        kind = "continuous" if self.T_s is None else f"T_s = {self.T_s:g} s"
        name = f"{self.origin.law.law.name}, " if self.origin else ""
        name = f"{self.around.name}, " if self.around else name
        return f"<{type(self).__name__} {name}{kind}, A {self.A.shape}>"

    # other loops

    def with_law(self, law: LinearLaw) -> Self:
        """The same plant under another law, or several; sampled plant and inner stage are kept."""
        return self._under(law, self.stage)

    def _under(self, law: LinearLaw, stage: LinearStage | None) -> Self:
        of = self.plant, law, self.T_s, self.u_delay, self.y_delay
        out = type(self)(*of, stage=stage, around=self.around)
        out.__dict__["held"] = self.held
        return out

    def sampled(self, T_s: float, delay: float = 0.0) -> Self:
        """A continuous loop with its law by Tustin at T_s and u held ``delay`` later, s."""
        return type(self)(self.plant, self.law.sampled(T_s), T_s, delay)

    def later(self, u: ArrayLike = 0.0, y: ArrayLike = 0.0) -> Self:
        """The sampled loop with more delay of each u and of each y, s; one number is for all."""
        u_delay, y_delay = self.u_delay + np.asarray(u), self.y_delay + np.asarray(y)
        of = self.origin, self.stage, self.around
        return type(self)(self.plant, self.law, self.T_s, u_delay, y_delay, *of)

    def scaled(self, u: ArrayLike = 1.0, y: ArrayLike = 1.0) -> Self:
        """The loop with u and y multiplied on their way, by complex numbers too; with an inner
        stage u (4,) is what goes to the bridge and y (11,) what comes from the sensors."""
        c = self.controller
        by_u, by_y = np.broadcast_to(u, len(c.D))[:, None], np.broadcast_to(y, c.D.shape[1])
        parts = (c.A, c.B * by_y, by_u * c.C, by_u * c.D * by_y, c.B_r, by_u * c.D_r)
        return self._under(LinearLaw(*parts, rows=c.rows), None)

    def changed(self, factors: Mapping[Element, float]) -> Self:
        """The loop anew, at its own operating point, with elements at factors of their values.

        Raises:
            NoEquilibrium: there is none with these elements.
        """
        of = self.made_of
        par, nominal = of.par.copy(), load_converter(of.plant.converter).pu()
        for name, factor in factors.items():
            par[name] = nominal[name] * factor
        return self._made(of.plant, of.law, of.ideal, of.ref, par)

    @property
    def made_of(self) -> Origin:
        """What the loop was made of.

        Raises:
            ValueError: it was made of matrices, or the converter is one of a network.
        """
        if self.around is not None:
            raise ValueError(f"{self.around.name}: is one of a network; this takes one on its line")
        if self.origin is None:
            raise ValueError("this loop was made of matrices, not of a plant and a law")
        return self.origin

    @property
    def op(self) -> OperatingPoint:
        """The operating point of the converter and its law.

        Raises:
            ValueError: the loop was made of matrices.
        """
        return self.made_of.op if self.around is None else self.around.op

    @property
    def ref(self) -> Matrix:
        """The references there, shape (5,), p.u.

        Raises:
            ValueError: the loop was made of matrices.
        """
        return self.made_of.ref if self.around is None else self.around.ref

    @property
    def dc_control(self) -> bool:
        """Whether i_u acts, since the DC source does not regulate itself."""
        return bool(self.plant.B[..., 0].any())

    # matrices

    @cached_property
    def controller(self) -> LinearLaw:
        """The law, and the inner stage if any, between the sensors and the bridge."""
        return self.law if self.stage is None else self.stage.around(self.law)

    @cached_property
    def held(self) -> LinearPlant:
        """The plant as the law meets it, from tick to tick with its delay lines or continuous."""
        T_s = self.T_s
        if T_s is None:
            return self.plant
        if self.around is not None:
            return self.around.held(self.u_delay, self.y_delay)
        reads = [(OMEGA_ROW, OMEGA_COLUMN)] if self.stage and self.stage.has_pll else []
        if self.plant.A.ndim == 2:
            return sampled_plant(self.plant, T_s, self.u_delay, self.y_delay, reads)
        p = self.plant
        single = [LinearPlant(*m) for m in zip(p.A, p.B, p.B_d, p.C, p.C_true, strict=True)]
        each = zip(single, self.u_delay, self.y_delay, strict=True)
        return LinearPlant.stacked([sampled_plant(of, T_s, u, y, reads) for of, u, y in each])

    @property
    def lines(self) -> list[slice]:
        """Where the delay line of each u, then of each y, is among the states of ``held``, for a
        single sampled loop."""
        if self.T_s is None:
            raise ValueError("a continuous loop has no delay lines; sample it first")
        delays = self.u_delay, self.y_delay
        if self.around is not None:
            return self.around.lines(*delays)
        return delay_lines(self.plant, self.T_s, *delays)

    @cached_property
    def A(self) -> Matrix:
        """The loop's matrix, shape (..., n, n)."""
        p, c = self.held, self.controller
        n, m = p.A.shape[-1], c.A.shape[-1]
        through = p.B @ c.D @ p.C
        out = np.empty((*np.broadcast_shapes(through.shape[:-2], c.A.shape[:-2]), n + m, n + m),
                       np.result_type(p.A, c.A, c.D))  # fmt: skip
        out[..., :n, :n], out[..., :n, n:] = p.A + through, p.B @ c.C
        out[..., n:, :n], out[..., n:, n:] = c.B @ p.C, c.A
        return out

    @cached_property
    def state_space(self) -> StateSpace:
        """(A, B, C, D) from ``INPUTS`` (7) to y = (v_dc, p, omega_u, q, V) before the sensors."""
        p, c, A = self.held, self.controller, self.A
        n, many = p.A.shape[-1], A.shape[:-2]
        B, D = np.zeros((*many, A.shape[-1], len(INPUTS))), np.zeros((*many, NY, len(INPUTS)))
        C = np.zeros((*many, NY, A.shape[-1]))
        B[..., :n, :NY], B[..., n:, :NY], B[..., :n, NY:] = p.B @ c.D_r, c.B_r, p.B_d
        C[..., :n] = p.C_true
        own = slice(OMEGA_ROW, OMEGA_ROW + 1), slice(2, 3)  # omega_u of u, and of y
        C[..., own[1], :n] = c.D[..., own[0], :] @ p.C
        C[..., own[1], n:] = c.C[..., own[0], :]
        D[..., own[1], :NY] = c.D_r[..., own[0], :]
        return A, B, C, D

    def performance(self, D_q: float = D_Q) -> StateSpace:
        """(A, B, C, D) of T from w = (P_ref, omega_g) to z = (P_ref - p, p, omega_u, q + V/D_q).

        Section III-B of the paper. omega_g is the grid's frequency; the law's own reference omega_g
        stays where it is (no PLL, as in the paper's MIMO-GFM).
        """
        A, B, C, D = self.state_space
        w, z = [_P_REF, _OMEGA_G], np.zeros((4, NY))
        z[0, _P], z[1, _P], z[2, 2], z[3, _Q], z[3, _V] = -1.0, 1.0, 1.0, 1.0, 1.0 / D_q
        D = z @ D[..., w]
        D[..., 0, 0] += 1.0
        return A, B[..., w], z @ C, D

    @cached_property
    def commands(self) -> tuple[int, ...]:
        """Those of u that act; i_u does not where the DC source regulates itself."""
        c = self.controller
        acts = self.plant.B.any(axis=0) & (c.C.any(axis=1) | c.D.any(axis=1))
        return tuple(int(j) for j in np.flatnonzero(acts))

    @cached_property
    def measurements(self) -> tuple[int, ...]:
        """Those of y that law and inner stage use for a command that acts."""
        c = self.controller
        used = c.B.any(axis=0) | c.D[list(self.commands)].any(axis=0)
        return tuple(int(i) for i in np.flatnonzero(used & self.plant.C.any(axis=1)))

    # results

    def modes(self) -> list[Mode]:
        """Modes of a single loop, the slowest to decay (largest sigma) first."""
        upper = [Mode.of(s) for s in self.poles() if s.imag >= 0.0]
        return sorted(upper, key=lambda mode: -mode.sigma)

    def channels(
        self, weights: tuple[Weight, ...] = PAPER_WEIGHTS, D_q: float = D_Q
    ) -> tuple[WeightedChannel, ...]:
        """The norm of every weighted channel W_ij T_ij; a sampled loop has the weights by Tustin.

        Raises:
            Unstable: the loop is not stable; it has no gamma.
        """
        return channel_norms(self.performance(D_q), weights, self.T_s)

    def gamma(self, weights: tuple[Weight, ...] = PAPER_WEIGHTS, D_q: float = D_Q) -> float:
        """The H-infinity norm of diag(W_ij T_ij), the largest of ``channels``.

        Raises:
            Unstable: the loop is not stable; it has no gamma.
        """
        return max(channel.norm for channel in self.channels(weights, D_q))

    def step_response(
        self, of: str = "P_ref", seconds: float = 1.0, every: float = T_S
    ) -> tuple[Matrix, Matrix]:
        """(t, y) after a unit step of one of ``INPUTS``: shapes (K,) in s and (K,5), p.u.

        y = (v_dc, p, omega_u, q, V) are deviations, before the sensors, and exact. A sampled loop
        gives every tick; ``every`` [s] is for a continuous one.

        Raises:
            ValueError: no such input.
        """
        return self._step(of, INPUTS, seconds, every)

    def frequency_response(self, omega: ArrayLike) -> Response:
        """The closed loop from ``INPUTS`` to y at omega [rad/s] (K,), shape (K, 5, 7)."""
        return response(self.state_space, self._at(omega))

    def loop_transfer(self, omega: ArrayLike, at_y: bool = False) -> Response:
        """L of all loops cut at u, or at y, so that S = (I + L)^-1; shape (K, 3, 3) or (K, 5, 5).

        omega [rad/s] has shape (K,). Delay, sensors and the omega_u loop of the law are in it.
        With an inner stage the cut is at the bridge, (K, 4, 4), or at the sensors, (K, 11, 11).
        """
        p, c, s = self.held, self.controller, self._at(omega)
        zero = np.zeros(c.D.shape[::-1])
        plant, law = response((p.A, p.B, p.C, zero), s), response((c.A, c.B, c.C, c.D), s)
        return -plant @ law if at_y else -law @ plant

    def loop_gain(self, at: str, omega: ArrayLike) -> Response:
        """L of one loop, cut at a channel of u or y while all others are closed, shape (K,).

        The loop is on the verge of stability where L = -1. Gain and phase margins are those of
        this L, see ``margins.locus``.

        Args:
            at: i_u, omega_u or E_u, or one of v_dc, p, q and V; with an inner stage E_u is the d
                axis of the bridge's voltage, and there are E_q, i_d, i_q, v_d, v_q, i_od and i_oq;
                see ``commands`` and ``measurements``.
            omega: frequencies, rad/s, shape (K,).

        Raises:
            ValueError: the loop does not use such a channel.
        """
        used = {U_CARRIED[j]: (j, False) for j in self.commands}
        used |= {Y_CARRIED[i]: (i, True) for i in self.measurements}
        if at not in used:
            raise ValueError(f"{at!r} is no channel of the loop; use one of {list(used)}")
        k, at_y = used[at]
        L = self.loop_transfer(omega, at_y)
        return np.asarray(1.0 / np.linalg.inv(np.eye(L.shape[-1]) + L)[:, k, k] - 1.0)

    def output_impedance(self, omega: ArrayLike) -> Response:
        """Z of the converter at its capacitor, as the grid sees it: shape (K, 2, 2), p.u. of Z_b.

        (-v_d, -v_q) = Z (i_od, i_oq) for small deviations, in the dq frame that turns steadily at
        the grid's frequency and lies on the converter's own frame in steady state, so that the
        synchronisation is part of Z (Wen et al., "Analysis of D-Q Small-Signal Impedance of
        Grid-Tied Inverters", IEEE Trans. Power Electron. 31(1), 2016). The line is not part of it.
        Of a sampled loop this is the answer at the frequency itself: sampling also excites its
        images at multiples of the sampling frequency.

        Args:
            omega: frequencies in the dq frame, rad/s, > 0, shape (K,).

        Raises:
            ValueError: the loop was made of matrices.
        """
        x, omega = self.made_of.op.x, np.asarray(omega, float)
        whole, s = self.plant, 1j * omega
        io = np.array([_I_O, _I_O + 1])
        others = np.delete(np.arange(len(whole.A)), io)
        delta = int(np.flatnonzero(others == DELTA)[0])
        turn = np.array([x[_I_O + 1], -x[_I_O]])  # of i_o in the converter's frame, by delta
        A, C = whole.A[np.ix_(others, others)], whole.C[:, others]
        by_i, y_by_i = whole.A[np.ix_(others, io)], whole.C[:, io]
        A[:, delta] += by_i @ turn
        C[:, delta] += y_by_i @ turn
        v = np.zeros((2, len(others)))
        v[0, _V_C], v[1, _V_C + 1] = 1.0, 1.0  # these come before i_o: the same places in others
        v[:, delta] = -x[_V_C + 1], x[_V_C]  # v in the steady frame, by delta
        alone = LinearPlant(A, whole.B[others], whole.B_d[others], C, whole.C_true[:, others])
        of = alone, self.law, self.T_s, self.u_delay, self.y_delay
        p, c, at = ClosedLoop(*of, stage=self.stage).held, self.controller, self._at(omega)
        n_y, n_u = p.C.shape[0], p.B.shape[1]
        G = response((p.A, p.B, p.C, np.zeros((n_y, n_u))), at)
        K = response((c.A, c.B, c.C, c.D), at)
        y = response((A, by_i, C, y_by_i), s) * np.exp(-s[:, None] * self.y_delay)[:, :, None]
        u = np.linalg.solve(np.eye(n_u) - K @ G, K @ y)
        if self.T_s is not None:
            u = u * acts(s, self.T_s, self.u_delay)
        zero = np.zeros((2, n_u + 2))
        v_by = response((A, np.hstack([alone.B, by_i]), v, zero), s)
        return -(v_by[..., n_u:] + v_by[..., :n_u] @ u)


def acts(s: Response, T_s: float, u_delay: Matrix) -> Response:
    """What a sampled command becomes where it acts, late and held over the tick, at s (K,): a
    factor for each, (K, m, 1)."""
    hold = (1.0 - np.exp(-s * T_s)) / (s * T_s)
    return np.asarray(hold[:, None] * np.exp(-s[:, None] * u_delay))[:, :, None]


def frequencies_near(poles: Response, across: Matrix = _ACROSS) -> Matrix:
    """Frequencies [rad/s] across the resonance of each pole [1/s], in no order: so many of its
    decay rates beside it."""
    return np.asarray(np.abs(poles.imag[:, None] + across * poles.real[:, None]).ravel())


class Responses:
    """C (s I - A)^-1 B + D at many s, from one Schur form of A.

    A, B and C are balanced first: without that, the largest elements would decide all rounding.
    """

    def __init__(self, A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> None:
        A, B, C = balance(A, B, C)
        self._T, Q = schur(A, output="complex")
        self._B, self._C, self._D = Q.conj().T @ B, C @ Q, D

    def __call__(self, s: Response) -> Response:
        """One a row of s."""
        T, (n, m) = self._T, self._B.shape
        x, at = np.tile(self._B, len(s)), np.repeat(s, m)
        for i in reversed(range(n)):
            x[i] = (x[i] + T[i, i + 1 :] @ x[i + 1 :]) / (at - T[i, i])
        return (self._C @ x).reshape(len(self._C), len(s), m).swapaxes(0, 1) + self._D


def response(of: StateSpace, s: Response) -> Response:
    """C (s I - A)^-1 B + D, one a row of s."""
    return Responses(*of)(s)


# --- the least stable mode, and the states that take part in it ---

_PLANT = ("i_d", "i_q", "v_d", "v_q", "i_od", "i_oq", "delta", "v_dc")  # gfm_plant.model
_SENSORS = tuple(f"sensor of {name}" for name in Y_NAMES if name != "omega_u")
_SHOWN = 4


@dataclass(frozen=True)
class LeastStable:
    """A mode of a loop, and its largest participation factors by state.

    The factor of state k is |l_k r_k| of the mode's left and right eigenvectors, divided by the sum
    over all states (Pérez-Arriaga, Verghese and Schweppe, 1982).
    """

    mode: Mode
    states: tuple[tuple[str, float], ...]

    def words(self) -> str:
        """The mode and its states in one line."""
        who = ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.states)
        return f"{self.mode.words()}: {who}"


def least_stable(loop: ClosedLoop) -> LeastStable:
    """The mode of a loop with the largest sigma, and the states that take part in it."""
    values, right = np.linalg.eig(loop.A)
    k = int(np.argmax(values.real if loop.T_s is None else np.abs(values)))
    shares = np.abs(np.linalg.inv(right)[k] * right[:, k])
    s = complex(values[k]) if loop.T_s is None else np.log(complex(values[k])) / loop.T_s
    names, shares = _states(loop), shares / shares.sum()
    assert len(names) == len(shares)
    largest = tuple((names[n], float(shares[n])) for n in np.argsort(-shares)[:_SHOWN])
    return LeastStable(Mode.of(s), largest)


def _states(loop: ClosedLoop) -> list[str]:
    """Names of the states of a single loop, in their order."""
    size, acts = len(loop.plant.A) - len(_PLANT), loop.plant.B.any(axis=0)
    names = [*_PLANT, *["integral of the DC source"] * (size % len(_SENSORS))]
    names += _SENSORS if size >= len(_SENSORS) else ()
    late = [*zip(U_CARRIED, loop.u_delay * acts, strict=False)]
    late += zip(Y_CARRIED, loop.y_delay, strict=False)
    for name, delay in late if loop.T_s else ():
        names += [f"{name} on its way"] * int(np.ceil(delay / loop.T_s - 1e-9))
    if loop.stage is not None and loop.stage.has_pll:
        names.append("omega_u that acts")
    names += [f"law's state of {U_NAMES[row]}" for row in loop.law.rows]
    return [*names, *(loop.stage.states if loop.stage else ())]
