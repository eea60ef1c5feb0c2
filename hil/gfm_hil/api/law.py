"""A law as an object: taken from the catalogue or a file, changed, shown, saved, run."""

from __future__ import annotations

import html
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gfm_hil.api.lti import cells_of, content_of, read_matrix
from gfm_hil.core.errors import UserError, naming, need
from gfm_hil.core.files import check_empty, write_new, write_text
from gfm_hil.results.page import fragment
from gfm_hil.results.table import Table
from gfm_hil.scenario import Scenario, load_scenario, toml_text
from gfm_plant import NoEquilibrium, Plant
from gfm_runtime import (
    BuiltLaw,
    DiscreteLaw,
    LawError,
    build_law,
    discretise,
    law_file,
    law_names,
    law_titles,
    parse_law,
)
from gfm_runtime.inner_file import named_inner
from gfm_runtime.lawfile import LawFile, tied
from gfm_runtime.signals import NU, NY, U_NAMES, Y_NAMES

if TYPE_CHECKING:
    from gfm_design.misses.tolerance import LatencyTolerance
    from gfm_design.model.closed_loop import ClosedLoop


def as_law(law: str | Path | Law) -> Law:
    """A law as it is, or that of a name or file."""
    return law if isinstance(law, Law) else Law.load(law)


@contextmanager
def law_files(laws: Sequence[str | Path | Law]) -> Iterator[dict[str, str]]:
    """What a scenario calls each law, by its name in results; a ``Law`` has a file while this
    lasts, which messages call by the name of the law."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-law-") as place:
        own = {
            str(law.save(Path(place) / f"{k}.toml")): law.name
            for k, law in enumerate(laws)
            if isinstance(law, Law)
        }
        saved = iter(own)
        files = [next(saved) if isinstance(law, Law) else str(law) for law in laws]
        try:
            yield {title: file for file, title in law_titles(files).items()}
        except UserError as problem:
            text = str(problem)
            for file, name in own.items():
                text = text.replace(file, name)
            raise UserError(text) from None


@contextmanager
def scenario_under(
    law: str | Path | Law | None,
    on: str | Path | Scenario | dict[str, Any],
    in_process: bool = True,
    **changes: Any,
) -> Iterator[Scenario]:
    """A scenario with its changes, and under a law if there is one; a ``Law`` has a file while this
    lasts. Raises UserError, LawError: as ``load_scenario``."""
    with law_files([] if law is None else [law]) as files:
        for file in files.values():
            changes = {**changes, "law": file}
        yield load_scenario(on, in_process=in_process, **changes)


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write texts by their paths within a folder, which is made. Raises OSError: it cannot be."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_text(folder / name, text)


def laws() -> tuple[str, ...]:
    """Names of the laws that ship."""
    return law_names()


def cell_text(file: LawFile, key: str) -> str:
    """One cell of the paper's Table II, e.g. ``IF×PD``, with the feedback-only term in braces; 0 if
    empty."""
    phi, psi = (
        "×".join(spec.type for spec in (one if isinstance(one, list) else [one]))
        for one in (file.phi.get(key, []), file.psi.get(key, []))
    )
    return phi + (f"{{{psi}}}" if psi else "") or "0"


def table_ii(file: LawFile) -> list[list[str]]:
    """The rows of Table II: an input of the converter, and its cells."""
    return [
        [u, *(cell_text(file, f"{i}{j}") for j in range(1, NY + 1))]
        for i, u in enumerate(U_NAMES, 1)
    ]


_OF_LOOP = {"references", "T_s"}  # what ``Law.closed_loop`` takes that no scenario has


@dataclass(frozen=True, repr=False)
class Law:
    """A grid-forming law, u = u_0 + Phi(s) (Y_ref − y) − Psi(s) y (Fig. 6 of the paper).

    Args:
        file: the content of its law file; see ``Law.load`` for a name or a path.
    """

    file: LawFile

    @classmethod
    def load(cls, name: str | Path) -> Law:
        """A law of the catalogue, or of a ``.toml`` file.

        Raises:
            LawError: an unknown name, or a file that is no law; every mistake is named.
        """
        return cls(law_file(str(name)))

    @classmethod
    def from_toml(cls, text: str) -> Law:
        """A law from the text of a law file.

        Raises:
            LawError: as ``load``.
        """
        made = cls(parse_law(text))
        made.built()
        return made

    @classmethod
    def from_matrix(
        cls, cells: Sequence[Sequence[Any]], name: str = "from-matrix", **tables: Any
    ) -> Law:
        """A law from Phi(s) cell by cell, p.u. and rad/s.

        Args:
            cells: 3 rows (i_u, omega_u, E_u) of 5 (v_dc, p, omega_u, q, V), each 0, a number,
                ``(num, den)`` in descending powers of s, a system of SciPy or python-control with
                one input and output, or an element as in a law file. Each of the first kinds gets
                a gain ``k_ij`` that a synthesis may move from a tenth to ten times its value.
            name: of the law.
            tables: other keys of a law file, e.g. ``title`` or ``u_0={"i_u": "P_ref"}``.

        Raises:
            UserError: another shape, or a cell that is none of these.
            LawError: a cell that is improper, unstable or integrates twice, and as ``load``.
        """
        about = {"name": name, "title": "a matrix of transfer functions", "source": "from_matrix"}
        return cls.from_toml(toml_text({**about, **tables, **read_matrix(cells)}))

    @classmethod
    def from_control(cls, system: Any, name: str = "from-control", **tables: Any) -> Law:
        """A law from Phi(s) as a system of python-control or SciPy, p.u. and rad/s.

        Args:
            system: continuous, transfer function or state space, 3 outputs and 5 inputs.
            name, tables: as for ``from_matrix``, which also says what the gains are.

        Raises:
            UserError: it is no such system.
            LawError: as ``from_matrix``.
        """
        about = {"name": name, "title": "a linear system", "source": "from_control"}
        return cls.from_toml(toml_text({**about, **tables, **content_of(cells_of(system))}))

    @property
    def name(self) -> str:
        """Its name, e.g. ``vsg-2``."""
        return self.file.name

    @property
    def gains(self) -> dict[str, float]:
        """Its parameters by name; ``units`` has their units."""
        return {name: spec.value for name, spec in self.file.parameters.items()}

    @property
    def units(self) -> dict[str, str]:
        """The unit of each parameter."""
        return {name: spec.unit for name, spec in self.file.parameters.items()}

    def with_gains(self, name: str | None = None, **gains: float) -> Law:
        """The same law with other values of some parameters.

        A parameter that the file ties to others follows them, unless it is given too.

        Args:
            name: of the new law; ``<name>-changed`` if None.
            gains: values by parameter, in the unit of the parameter.

        Raises:
            LawError: no such parameter, or a value that makes no law.
        """
        for gain in gains:
            if gain not in self.file.parameters:
                known = sorted(self.file.parameters)
                raise LawError(f"parameter {gain}", f"unknown to {self.name}; known: {known}")
        content = self.file.model_dump(mode="json", exclude_none=True)
        for gain, value in (tied(self.file, gains) | gains).items():
            content["parameters"][gain] |= {"value": float(value), "source": "with_gains"}
        content["name"] = name or f"{self.name.removesuffix('-changed')}-changed"
        return Law.from_toml(toml_text(content))

    def with_inner(self, inner: str | None, name: str | None = None, **changed: Any) -> Law:
        """The same law with an inner stage between it and the bridge.

        Args:
            inner: name of a shipped stage (``virtual-stator``, ``cascaded``,
                ``threshold-impedance``), path of a file, or ``none``; None: its own stage.
            name: of the new law; ``<name>-changed`` if None.
            changed: keys of the stage, e.g. ``I_max=1.1``, ``priority="q"``,
                ``power={"P_max": 1.0, "P_min": -1.0}``.

        Raises:
            LawError: no such stage or key, or a value that is not allowed.
        """
        spec = self.file.inner if inner is None else named_inner(inner)
        if spec is None and changed:
            raise LawError("inner", f"none has no keys; given are {[*changed]}")
        content = self.file.model_dump(mode="json", exclude_none=True)
        content.pop("inner", None)
        if spec is not None:
            content["inner"] = spec.model_dump(mode="json", exclude_none=True) | changed
        content["name"] = name or f"{self.name.removesuffix('-changed')}-changed"
        return Law.from_toml(toml_text(content))

    def built(self) -> BuiltLaw:
        """Its elements as numbers, which the runtime works with."""
        return build_law(self.file)

    def discretised(self, T_s: float = 1e-4) -> DiscreteLaw:
        """Its matrices after Tustin at T_s [s], which the kernel runs."""
        return discretise(self.built(), T_s)

    def to_control(self) -> Any:
        """Phi(s) as a transfer matrix of python-control, 3 × 5, p.u. and rad/s.

        Raises:
            UserError: python-control is not installed.
        """
        need("control", "python-control", "to_control", "design")
        import control

        built = self.built()
        cells = [[built.element("phi", (i, j)) for j in range(NY)] for i in range(NU)]
        num = [[e.num[::-1] for e in row] for row in cells]
        den = [
            [reduce(np.convolve, e.den, np.ones(1))[::-1].tolist() for e in row] for row in cells
        ]
        return control.tf(num, den, inputs=[f"error_{y}" for y in Y_NAMES], outputs=list(U_NAMES))

    def closed_loop(
        self,
        on: str | Path | Scenario | Plant | None = None,
        *,
        converter: str | None = None,
        ideal: bool = False,
        **more: Any,
    ) -> ClosedLoop:
        """This law around a plant, linearised at their operating point.

        Args:
            on: a scenario (name, file or ``Scenario``), of which plant, references, sampling time
                and inner stage count, or a plant alone; the paper's converter without delay and
                sensors if None.
            converter: of a scenario with a network the converter that gets this law, while the
                others keep theirs.
            ideal: the continuous loop, neither sampled nor delayed; not of a network.
            more: ``references`` (V_dcref, P_ref, omega_g, Q_ref, V_ref) in p.u. and ``T_s`` in s,
                instead of those of the scenario; and keys of the scenario with ``__`` for the dot,
                as ``run`` takes them, e.g. ``plant__grid={"scr": 3.0, "x_over_r": 6.0}``.

        Raises:
            UserError: no such scenario, or there is no operating point.
            LawError: the law cannot be discretised at T_s; ``ideal`` with an inner stage, which
                runs from tick to tick.
        """
        from gfm_design.model.closed_loop import ClosedLoop
        from gfm_hil.studies.linear_loop import loop_under

        changes = {key: more.pop(key) for key in more.keys() - _OF_LOOP}
        if isinstance(on, str | Path | Scenario):
            on = load_scenario(on, **changes)
        elif changes:
            raise UserError(f"{', '.join(changes)}: no scenario that it could change")
        try:
            if not isinstance(on, Scenario):
                return ClosedLoop.of(self.built(), on, ideal=ideal, **more)
            law = build_law(self.staged(on, converter))
            if converter is None:
                more = {"references": on.references.vector(), "T_s": on.T_s, **more}
                loop = ClosedLoop.of(law, on.plant, ideal=ideal, **more)
                loop.where = on.title
                return loop
            if ideal or more:
                raise UserError(f"{', '.join(more) or 'ideal'}: not of a converter of a network")
            return loop_under(law, on, converter)
        except NoEquilibrium as problem:
            raise UserError(str(problem)) from None

    def latency_tolerance(
        self, on: str | Path | Scenario | Plant | None = None, **more: Any
    ) -> LatencyTolerance:
        """What this law bears of late and of lost commands: ``gfmhil.design.latency_tolerance``
        with the same arguments."""
        from gfm_hil.api.design import latency_tolerance

        return latency_tolerance(self, on, **more)

    def staged(self, scenario: Scenario, converter: str | None = None) -> LawFile:
        """Its law file with the inner stage that a scenario gives its laws, if it gives one.

        Args:
            converter: of a scenario with a network, which one has this law.

        Raises:
            UserError: no such converter; or none is named, and the scenario has a network.
        """
        names = scenario.converters
        if converter not in names and (names or converter is not None):
            allowed = f"one of {names}" if names else "left out: the scenario has no network"
            raise UserError(f"converter = {converter!r}: must be {allowed}")
        return self.file.behind((scenario if converter is None else scenario.each[converter]).inner)

    def to_c(
        self,
        folder: str | Path,
        T_s: float = 1e-4,
        real: str = "float32",
        f_n: float = 50.0,
        *,
        overwrite: bool = False,
    ) -> Path:
        """Write this law as C99 with golden vectors and a self-test, as ``gfmhil firmware export``
        does; returns the folder.

        Args:
            folder: new or empty, unless ``overwrite``.
            T_s: sampling time, s.
            real: ``float32`` or ``float64``.
            f_n: rated frequency of the converter, Hz, for an inner stage.
            overwrite: replace files of an export before.

        Raises:
            UserError: the folder is not empty or cannot be written.
            LawError: the law cannot be discretised at T_s, or a number overflows ``real``.
        """
        from gfm_runtime.firmware import export

        folder = Path(folder)
        if not overwrite:
            check_empty(folder)
        omega_b = 2 * math.pi * f_n
        files = export({self.name: self.built()}, T_s, real, "unrolled", omega_b)
        with naming(folder):
            write_files(folder, files)
        return folder

    def to_toml(self) -> str:
        """The text of its law file."""
        return toml_text(self.file.model_dump(mode="json", exclude_none=True))

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write a law file; returns its path.

        Raises:
            UserError: it is there already and not to ``overwrite``, or cannot be written.
        """
        return write_new(Path(path), self.to_toml(), overwrite)

    def __repr__(self) -> str:
        rows = [["", *Y_NAMES], *table_ii(self.file)]
        wide = [max(len(row[j]) for row in rows) for j in range(NY + 1)]
        matrix = (
            "  " + "  ".join(x.ljust(n) for x, n in zip(row, wide, strict=True)).rstrip()
            for row in rows
        )
        return "\n".join([f"<Law {self.name}: {self.file.title}", *matrix, ">"])

    def _repr_html_(self) -> str:
        """The matrix of elements and the parameters, for a notebook."""
        title = f"{self.name}: {self.file.title}"
        table = fragment(Table(["Φ(s)", *Y_NAMES], table_ii(self.file), title=title, text=None))
        gains = ", ".join(
            html.escape(f"{name} = {value:g} {self.units[name]}".removesuffix(" 1"))
            for name, value in self.gains.items()
        )
        return f"{table}<p>{gains}</p>"
