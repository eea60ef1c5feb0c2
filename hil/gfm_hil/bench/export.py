"""Results of ``gfmhil bench latency`` for other tools."""

import io
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.bench.histogram import SHARES, bars
from gfm_hil.core.errors import UserError, need

Row = dict[str, Any]
_MOST_NS, _DIGITS = 3_600_000_000_000, 3  # of an HdrHistogram


def export(content: Row, form: str, path: Path) -> None:
    """Write the round trips of a result. Raises UserError: it has none, or a package is missing."""
    rows = [row for row in content["results"] if row["n"]]
    if not rows:
        raise UserError("the result has no round trips to export")
    _, write = FORMATS[form]
    path.write_text(write(content, rows), encoding="utf-8")


def _name(row: Row) -> str:
    return f"{row['name']}, {row['mode']}, {row['load']}"


def _hdr(content: Row, rows: list[Row]) -> str:
    """A line for each row, with its name as the tag."""
    need("hdrh", "hdrhistogram", "hdr:", "bench")
    from hdrh.histogram import HdrHistogram
    from hdrh.log import HistogramLogWriter

    out = io.StringIO()
    log = HistogramLogWriter(out)
    log.output_log_format_version()
    log.output_comment(f"[StartTime: {time.time():.3f} (seconds since epoch)]")
    log.output_legend()
    for row in rows:
        histogram = HdrHistogram(1, _MOST_NS, _DIGITS)
        for value, count in zip(*bars(row["histogram"]), strict=True):
            histogram.record_value(max(1, int(value)), int(count))
        histogram.set_tag(_name(row).replace(", ", "-").replace(" ", "_"))
        log.output_interval_histogram(histogram, 0, content["seconds"], 1e6)
    return out.getvalue()


def _github(content: Row, rows: list[Row]) -> str:
    """As its tool ``customSmallerIsBetter`` reads it."""
    return json.dumps([
        {"name": f"{_name(row)}, {key.replace('_', '.')}", "unit": "µs", "value": row[f"{key}_us"],
         "extra": f"n = {row['n']}"}
        for row in rows for key in SHARES
    ], indent=1, ensure_ascii=False) + "\n"  # fmt: skip


def _pytest(content: Row, rows: list[Row]) -> str:
    benchmarks = [
        {
            "group": f"{row['mode']}, {row['load']}", "name": _name(row), "fullname": _name(row),
            "params": None, "param": None, "extra_info": {}, "options": {},
            "stats": _statistics(row),
        }
        for row in rows
    ]  # fmt: skip
    environment = content["environment"]
    return json.dumps({
        "machine_info": {"node": "", "processor": environment["cpu"],
                         "release": environment["kernel"],
                         "python_version": environment["python"]},
        "commit_info": {}, "benchmarks": benchmarks, "version": "5.1.0",
        "datetime": time.strftime("%Y-%m-%dT%H:%M:%S+00:00", time.gmtime()),
    }, indent=1) + "\n"  # fmt: skip


def _statistics(row: Row) -> dict[str, Any]:
    """In s, from the histogram."""
    at, counts = bars(row["histogram"])
    at = at * 1e-9
    mean = float(np.average(at, weights=counts))
    share = np.cumsum(counts) / counts.sum()
    q1, median, q3 = (float(at[np.searchsorted(share, q)]) for q in (0.25, 0.5, 0.75))
    return {
        "min": float(at[0]), "max": float(at[-1]), "mean": mean,
        "stddev": float(np.sqrt(np.average((at - mean) ** 2, weights=counts))),
        "rounds": int(counts.sum()), "median": median, "iqr": q3 - q1, "q1": q1, "q3": q3,
        "iqr_outliers": 0, "stddev_outliers": 0, "outliers": "0;0", "ld15iqr": float(at[0]),
        "hd15iqr": float(at[-1]), "ops": 1 / mean, "total": float(at @ counts), "iterations": 1,
    }  # fmt: skip


def _prometheus(content: Row, rows: list[Row]) -> str:
    """A summary for each row."""
    name = "gfmhil_round_trip_seconds"
    lines = [f"# HELP {name} A message there and its answer back.", f"# TYPE {name} summary"]
    for row in rows:
        labels = ",".join(
            f"{key}={json.dumps(str(row[key]), ensure_ascii=False)}"
            for key in ("name", "mode", "load", "policy")
        )
        for key, share in SHARES.items():
            lines.append(f'{name}{{{labels},quantile="{share:g}"}} {row[f"{key}_us"] * 1e-6:.9g}')
        at, counts = bars(row["histogram"])
        lines.append(f"{name}_sum{{{labels}}} {float(at @ counts) * 1e-9:.9g}")
        lines.append(f"{name}_count{{{labels}}} {row['n']}")
    return "\n".join(lines) + "\n"


#: by name what reads them, and what writes them
FORMATS = {
    "hdr": ("HdrHistogram log", _hdr),
    "github": ("JSON of github-action-benchmark", _github),
    "pytest": ("JSON of pytest-benchmark", _pytest),
    "prometheus": ("text format of Prometheus", _prometheus),
}
