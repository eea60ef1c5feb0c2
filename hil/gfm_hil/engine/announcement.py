"""Which command servers a run folder announces; a killed process leaves its file behind."""

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
    """What a role that is running says of itself: where its command server is, and its laws."""

    endpoint: str
    T_s: float = 0.0
    names: list[str] = []
    laws: list[_Law] = []


def announcement(folder: Path, role: Role) -> Path:
    """The file in which a role's command server says how to reach it."""
    return folder / f"commands_{role}.json"


def announced(folder: Path, role: Role) -> dict[str, Any] | None:
    """What a role's command server announces, or None if no living process has one. Raises
    UserError: the file or process cannot be examined; the run itself may be fine."""
    file = announcement(folder, role)
    try:
        found = Announcement(**read_json(file, Announcement))
        place = Path(found.endpoint.removeprefix(SCHEME)).parent
        return found.model_dump() if scratch.held(place) else None
    except FileNotFoundError:
        return None
    except OSError as problem:
        raise UserError(f"{file}: {problem.strerror}") from None
    except ValueError as problem:  # a zero byte in the name of a folder
        raise UserError(f"{file}: endpoint: {problem}") from None


def present(folder: Path) -> list[Role]:
    """The roles whose command server is alive. Raises UserError: a file or process cannot be
    examined."""
    return [role for role in ROLES if announced(folder, role) is not None]


def not_running(folder: Path) -> UserError:
    """The error that no run is going on in a folder."""
    of = sorted(path.parent.name for path in folder.glob("*/scenario.toml"))
    if of and (folder / "scenario.toml").is_file():
        return UserError(f"{folder}: is of a network; name the folder of a converter: one of {of}")
    return UserError(f"{folder}: no run is going on there")
