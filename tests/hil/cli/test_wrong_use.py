"""What a command cannot do is one line and exit code 2, and nothing is printed, written or started.

A row is a command and a part of that line, or all of it if it begins with ``gfmhil: ``.
"""

import shlex
from pathlib import Path

import pytest

from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario, toml_text

SHORT = {"title": "short [run]", "duration": 0.3, "link": {"type": "inproc"}}
TWO = {
    "title": "two", "duration": 0.5, "law": "droop-3", "link": {"type": "zmq"},
    "network": {
        "converters": {"A": {"node": "bus", "law": "vsg-2"}, "B": {"node": "bus"}},
        "loads": {"base": {"node": "bus", "P": 0.6, "Q": 0.1}},
    },
}  # fmt: skip
WRONG = """
# runs, comparisons and laws
compare short.toml | compare list is empty
compare short.toml --laws vsg-2,,vsg-1 | none empty
compare short.toml --laws vsg-99 | vsg-99
run short.toml --law bad.toml | law file bad.toml: phi.22.typ
run short.toml --law vsg2 | did you mean 'vsg-2'?
run short.toml --link can --option every=99 | --option every 99
command run Pref=1 | did you mean 'P_ref'?
run nowhere.toml | nowhere.toml: no such file
run short.toml --duration -1 | duration
run short.toml --duration nan | duration
run short.toml --seed -1 | seed
run short.toml --mode realtime | lockstep only
run short.toml --link zmq --endpoint x | tcp://host:port
run short.toml --out short.toml/x | not a folder
run wrong.toml --out out | wrong.toml: duration: must be a valid number
compare wrong.toml --laws vsg-2 --out out | wrong.toml: duration: must be a valid number
plant wrong.toml --endpoint ipc://x --out out | wrong.toml: duration: must be a valid number
run wrong-plant.toml --out out | factors.L_f = -1.0: must be
plant short.toml | a side alone needs a link
plant short.toml --link zmq | link.endpoint: not set
laws show vsg-99 | vsg-99
run short.toml --zzz 3 | gfmhil: --zzz 3: gfmhil run does not know it
firmware export vsg-1 --reel float32 -o out | does not know it; did you mean '--real'?
design poles own.toml | a law's file comes after --law, a scenario's after --scenario
run virtual P_ref=0.8 | a scenario's file says such values
runn pref_step | runn: no command; did you mean 'run'? must be one of ['run'
# benchmarks
bench latency --links carrier-pigeon --out out | carrier-pigeon
bench latency --links shm, --out out | --links
bench latency --mode fast --out out | --mode
bench latency --load heavy --out out | --load
bench latency --payload 0 --out out | --payload
bench latency --seconds nan --out out | --seconds
bench latency --rounds 0 --out out | --rounds
bench jitter --load idle,heavy --out out | --load
bench kernel --laws vsg-99 --out out | vsg-99
bench loop --seconds 0.01 --out out | --seconds
bench loop --laws droop-1, --out out | --laws
bench all --links inproc --out out | inproc
bench compare no-such no-such --interleave 1 --out out --quiet | --interleave 1
bench compare no-such no-such --interleave 2 --what compare --out out --quiet | --what
bench compare no-such no-such --interleave 2 --out out --quiet | no such command
# CAN
dbc --out nowhere/link.dbc | gfmhil: --out nowhere/link.dbc: No such file or directory
dbc --budget --T_s 0 | gfmhil: --T_s 0: must be more than 0 s
# conformity
conform --law droop-3 --against misso | did you mean
conform --law drop-3 | drop-3
conform --law droop-3 --inner stator | stator
conform --law droop-3 --workers 0 | workers = 0
conform --law droop-3 --converter nowhere.toml | nowhere.toml
conform | --law
conform --controller vsg-2.so | must be dll:FILE, fmu:FILE, c:FILE or pil:TARGET
conform --controller dll:nowhere.so | nowhere.so: there is no such file
conform --law droop-3 --map map.toml | map.toml: is of a controller
conform --controller c:own.so | measures currents, which only a run with an inner stage
conform --controller c:own.so --inner none | choose --inner virtual-stator
run short.toml --controller dll:x | which a run in process has not; choose a link
run short.toml --map x | a port map is for an external controller
plant short.toml --link shm --endpoint shm://x --model dll:x | --model
# design
design gamma --law no-such-law | no-such-law
design gamma --law vsg-2 --gains k_99=1 | k_99
design gamma --law vsg-2 --gains k_34 | NAME=NUMBER
design gamma --law vsg-2 --gains k_34=nan | NAME=NUMBER
design gamma --law vsg-2 --gains '' | NAME=NUMBER
design gamma --law vsg-2 --gains k_34=1,k_34=2 | twice
design gamma --law vsg-2 --gains k_22=0 | k_22
design gamma --law vsg-2 --weights no-such-file | no-such-file
design tune --law vsg-2 --gains k_99=1 | k_99
design tune --law vsg-2 --gains k_34=1e9 | outside
design tune --law vsg-2 --only k_99 | k_99
design tune --law vsg-2 --only '' | free are
design tune --law vsg-2 --only k_22 --gains k_34=2 | among those to move
design tune --law vsg-2 --out no-such-folder/x.toml | no-such-folder
design tune --law vsg-2 --evaluations 0 | at least 1
design tune --law vsg-2 --seed -1 | negative
design bode --at omega_g | omega_g
design bode --inner no-such-stage | no-such-stage
design gamma --law vsg-2 --inner virtual-stator --discrete | sampled at 10 kHz in any case
design tune --law vsg-2 --inner virtual-stator --full-order | law on the bridge; use --inner none
design nyquist --law no-such-law | no-such-law
design step --of P | 'P' is no input of the loop
design poles --out poles.none | poles.none
design box --law mimo-gfm | python -m deployable check takes the same options
# frequency scans
scan nothing --quiet | is neither a law (gfmhil laws) nor a scenario
scan pref_step --scenario pref_step --quiet | goes with a law
scan vsg-2 --from 9 --to 5 --quiet | must be 0.01 <= start_hz < stop_hz
scan vsg-2 --points 1 --quiet | points = 1: must lie in [2, 1000]
scan vsg-2 --amplitude 1 --quiet | would move V_g by
scan vsg-2 --amplitude -1 --quiet | amplitude = -1.0: must be > 0
scan vsg-2 --settle -1 --quiet | settle_s = -1.0: must be >= 0 s
scan vsg-2 --window 99 --quiet | window_s = 99.0: must lie in [0, 60] s
scan three_share_a_load --quiet | a scan measures one converter
scan small_grid_load_step --quiet | plant.grid.finite: such a grid sets its own frequency
scan pref_step --inner nothing --quiet | nothing
scan pref_step --controller true --scenario x --quiet | goes with a law
# export and ports
export nowhere --format csv | nowhere: is not a run folder (signals.npz is missing)
export run | --format is not given: must be one of mf4, csv, mat, parquet, blf
export run -o x.xls | --format is not told by x.xls: must be one of mf4, csv
export run -o no/folder/x.csv | no/folder/x.csv: No such file or directory
export run -o no/folder/x.mf4 | no/folder/x.mf4: No such file or directory
export run -o no/folder/x.mat | no/folder/x.mat: No such file or directory
export run -o no/folder/x.parquet | no/folder/x.parquet: No such file or
stream nowhere | nowhere: no run is going on there; --wait waits for one
stream over | over: the run is over, see gfmhil export
stream x --port 65535 | --port 65535: has no next one, give --blocks
stream x --blocks -1 | --blocks -1: must be 0
stream x --rate 0 | --rate 0: must lie in [0.1, 1e6] Hz
stream x --rate nan | --rate nan: must lie in
xcp x --can can0 --ids 7,7 | --ids 0x7,0x7: must be two different ones of 0 to 0x7ff
xcp x --can can0 --ids 0x800,1 | --ids 0x800,0x1: must be two different ones
xcp x --can can0 --ids 7 | --ids 0x7: must be two different ones
xcp x --can can0 --ids a,b | --ids a,b: must be two numbers
xcp x --host 0.0.0.0 | --plain if it shall
xcp x --host 0.0.0.0 --plain | no run is going on there
scope nowhere | nowhere: not a run folder
scope run --cert a.pem | --cert, --key: give both
scope run --cert a.pem --key b.pem | --cert a.pem
scope run --host 203.0.113.1 --plain | --host 203.0.113.1
scope broken | broken: not a run folder: scenario.toml
# firmware
firmware export vsg-2 --style records --real fixed -o out | \
--style records: fixed point has its constants in
firmware export vsg-2 --inner cascaded --real fixed -o out | \
law 'vsg-2': has an inner stage, which fixed point
firmware export mimo-gfm-scheduled --real fixed -o out | \
law 'mimo-gfm-scheduled': is scheduled, which fixed point
firmware export all vsg-1 -o out | law 'vsg-1': is named twice
firmware golden vsg-1 --ticks 0 | --ticks 0: must lie in [1, 1000000]
firmware export vsg-1 vsg-1 -o out | law 'vsg-1': is named twice
firmware export vsg -o out | law 'vsg': unknown
firmware export vsg-1 --inner cascade -o out | did you mean 'cascaded'
firmware export vsg-1 --f_n 0 -o out | --f_n 0: must be > 0 Hz
firmware export vsg-1 --T_s 0 -o out | T_s: 0.0 s must be > 0
firmware fmu vsg-1 -o no/law.fmu | no/law.fmu: No such file or directory
# networks
controller two.toml --out out | --converter: which one this controller controls; one of ['A', 'B']
controller two.toml --out out --converter C | --converter C: must be one of ['A', 'B']
plant two.toml --out out --converter A | --converter A: for the controller of a network
plant two.toml --out out --endpoint C=ipc:///tmp/c | \
--endpoint C=ipc:///tmp/c: must be NAME=ENDPOINT with NAME in ['A', 'B']
plant two.toml --out out --endpoint A=ipc:///tmp/a | link.endpoint of B: not set
plant two.toml --out out --endpoint A=ipc:///tmp/a --endpoint A=ipc:///tmp/b | \
--endpoint A=ipc:///tmp/b: given twice for A
run two.toml --out out --endpoint A=ipc:///tmp/a | here a scenario names it, as
run two.toml --out out --scope | --scope: looks at one converter; start gfmhil scope beside
run three_share_a_load --law vsg-2 --out out | \
law vsg-2: does not replace the own law of A, B, C; name the converter that gets it with --converter
run three_share_a_load --converter a --out out | \
--converter a: must be one of ['A', 'B', 'C']; did you mean 'A'?
run three_share_a_load --law vsg2 --converter B --out out | network.converters.B.law: law 'vsg2'
run pref_step --converter A --out out | --converter A: the scenario has no network
compare three_share_a_load --laws vsg-2,droop-3 | \
three_share_a_load: network: this takes one converter
run three_share_a_load --controller dll:x --out out | controls one converter
"""
#: these compile the start of several converters
WRONG_OF_NETWORKS = """
design gamma --law vsg-2 --scenario three_share_a_load | --converter names the one of ['A',
design gamma --law vsg-2 --converter A | --converter A: needs --scenario
design tune --law vsg-2 --scenario three_share_a_load --converter A --full-order | omit --scenario
design gamma --law vsg-2 --scenario three_share_a_load --converter A --discrete | \
a scenario is sampled in any case
design tune --law vsg-2 --decay -1 | decay = -1.0: must be finite and not negative
design margins --scenario three_share_a_load | --converter names it, one of ['A', 'B', 'C']
design bode --scenario three_share_a_load --converter D | must be one of ['A', 'B', 'C']
design bode --converter A | --converter A: the scenario has no network
design poles --scenario three_share_a_load --law vsg-2 | \
--law vsg-2: does not replace the own law of A, B, C; name the converter that gets it
design step --scenario three_share_a_load --of P_ref | 'P_ref' is no input of the network
design margins --scenario three_share_a_load --converter A --figures x | --figures: they
design poles --scenario three_share_a_load --converter A --law no-such | no-such
"""


def rows(text: str) -> list[str]:
    return [line for line in text.splitlines() if line and not line.startswith("#")]


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with what the commands name."""
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "short.toml").write_text(toml_text(SHORT))
    (folder / "two.toml").write_text(toml_text(TWO))
    law = 'name="a"\ntitle=""\nsource=""\nphi.22={type="P", k=0, typ=1}'
    (folder / "bad.toml").write_text(law)
    (folder / "wrong.toml").write_text(toml_text({**SHORT, "duration": "3"}))
    plant = {"factors": {"L_f": -1.0}}
    (folder / "wrong-plant.toml").write_text(toml_text({**SHORT, "plant": plant}))
    (folder / "own.so").touch()
    for name in ("over/summary.json", "broken/scenario.toml"):
        (folder / name).parent.mkdir()
        (folder / name).write_text("= 1")
    run_scenario(check_scenario({**SHORT, "duration": 0.01}, "short"), folder / "run")
    return folder


@pytest.mark.parametrize(
    "row", rows(WRONG) + [pytest.param(r, marks=pytest.mark.full) for r in rows(WRONG_OF_NETWORKS)]
)
def test_a_command_that_cannot_be_is_one_line(row, place, refused, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.setattr("os.nice", lambda by: by)  # it would last for all of pytest
    before = sorted(place.rglob("*"))
    command, _, said = row.partition(" | ")
    line = refused(*shlex.split(command))
    assert line == f"{said}\n" if said.startswith("gfmhil: ") else said in line
    assert sorted(place.rglob("*")) == before
