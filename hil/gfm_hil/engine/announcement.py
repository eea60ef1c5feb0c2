"""The file by which a role tells other processes where its command server is.

A process that is killed leaves the file behind, so a reader also checks that the process lives.
"""

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import read_json
from gfm_hil.core.roles import ROLES, Role

SCHEME = "ipc://"
LARGEST = 65536  # bytes of a command, and of its answer


class _Law(BaseModel):
    """A law to which the recording's law indices refer."""

    label: str
    name: str
    title: str = ""
    gains: dict[str, float]


class Announcement(BaseModel):
    """Endpoint of a running role's command server, T_s in s, and the laws that are ready."""

    endpoint: str
    T_s: float = 0.0
    names: list[str] = []
    laws: list[_Law] = []


def announcement_file(folder: Path, role: Role) -> Path:
    """The file of a run folder with the announcement of a role."""
    return folder / f"commands_{role}.json"


def read_announcement(folder: Path, role: Role) -> dict[str, Any] | None:
    """The announcement of a role's command server, or None if it has none that runs. Raises
    UserError: the file or process cannot be examined; the run itself may be fine."""
    file = announcement_file(folder, role)
    try:
        server = Announcement(**read_json(file, Announcement))
        place = Path(server.endpoint.removeprefix(SCHEME)).parent
        return server.model_dump() if scratch.held(place) else None
    except FileNotFoundError:
        return None
    except OSError as problem:
        raise UserError(f"{file}: {problem.strerror}") from None
    except ValueError as problem:  # a zero byte in the name of a folder
        raise UserError(f"{file}: endpoint: {problem}") from None


def running_roles(folder: Path) -> list[Role]:
    """The roles whose command server runs. Raises UserError: a file or process cannot be
    examined."""
    return [role for role in ROLES if read_announcement(folder, role) is not None]


def members(folder: Path) -> list[Path]:
    """The folders of a network's converters; none if the folder is not of a network."""
    if not (folder / "scenario.toml").is_file():
        return []
    return sorted(path.parent for path in folder.glob("*/scenario.toml"))


def not_running(folder: Path) -> UserError:
    """The error that no run is going on in a folder."""
    if names := [member.name for member in members(folder)]:
        return UserError(
            f"{folder}: is of a network; name the folder of a converter: one of {names}"
        )
    why = "no run is going on there" if folder.exists() else "no such folder"
    return UserError(f"{folder}: {why}")
