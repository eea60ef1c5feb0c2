"""The records of a campaign on disk: JSON, one run a line, so that nothing done is ever lost."""

from __future__ import annotations

import json
import os
from importlib.metadata import version
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import Job, Record

FILE = "runs.jsonl"


class Store:
    """``runs.jsonl`` of a campaign's folder: a line about the campaign, then its records.

    Args:
        folder: of the campaign; made if need be. None keeps the records in memory only.
        campaign: whose records these are.
        resume: go on with what is there, if anything.

    Raises:
        UserError: the folder is in use, or holds the records of another campaign.
    """

    def __init__(self, folder: Path | None, campaign: Campaign, resume: bool) -> None:
        self._path = None if folder is None else folder / FILE
        self.records: dict[Job, Record] = {}
        if folder is None or self._path is None:
            return
        if self._path.is_file() and resume:
            self._read(self._path, campaign)
            return
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            more = ", or go on with it: resume" if self._path.is_file() else ""
            raise UserError(f"{folder}: is in use; choose another folder{more}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "campaign.toml").write_text(campaign.text, encoding="utf-8")
            self._write([{"digest": campaign.digest(), "version": version("gfmhil")}])
        except OSError as problem:
            raise UserError(f"{folder}: {problem.strerror}; choose another --out") from None

    def _read(self, path: Path, campaign: Campaign) -> None:
        whole = path.read_bytes()
        kept = whole[: whole.rfind(b"\n") + 1]  # the last line may have been cut off
        try:
            head, *records = [json.loads(line) for line in kept.splitlines()]
            made_by, digest = head["version"], head["digest"]
            self.records = {(r["run"], r["law"]): r for r in records}
        except (ValueError, KeyError, TypeError) as problem:
            raise UserError(f"{path}: cannot be read: {problem!r}") from None
        if made_by != version("gfmhil"):
            raise UserError(
                f"{path}: made by gfmhil {made_by}, this is {version('gfmhil')}; "
                "choose another --out"
            )
        if digest != campaign.digest():
            raise UserError(
                f"{path}: belongs to another campaign: the file, its scenario or a law has "
                f"changed since (see campaign.toml there); choose another --out"
            )
        if len(kept) < len(whole):
            with path.open("r+b") as file:
                file.truncate(len(kept))

    def append(self, records: list[Record]) -> None:
        """Keep some records; a store with a folder has them on the disk when this returns."""
        self._write(records)
        self.records.update({(r["run"], r["law"]): r for r in records})

    def _write(self, lines: list[Record]) -> None:
        if self._path is None:
            return
        with self._path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(line) + "\n" for line in lines))
            file.flush()
            os.fsync(file.fileno())

    def missing(self, campaign: Campaign) -> list[Job]:
        """What is still to be run, in order of the run numbers."""
        jobs = [(run, law) for run in range(campaign.file.runs) for law in campaign.file.laws]
        return [job for job in jobs if job not in self.records]

    def sorted(self, campaign: Campaign) -> list[Record]:
        """The records of the campaign's runs, by run number and law."""
        laws, runs = campaign.file.laws, campaign.file.runs
        wanted = [r for r in self.records.values() if r["run"] < runs and r["law"] in laws]
        return sorted(wanted, key=lambda r: (r["run"], laws.index(r["law"])))
