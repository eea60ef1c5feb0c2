"""Run folders as files that other tools open: MF4, MAT, Parquet, CSV, and CAN traffic as BLF."""

from gfm_hil.results.export.formats import FORMATS, export_run

__all__ = ["FORMATS", "export_run"]
