"""The two roles of a run: the controller and the plant."""

from __future__ import annotations

from typing import Literal

Role = Literal["controller", "plant"]
ROLES: tuple[Role, ...] = ("controller", "plant")

#: what this project's own controller calls itself
OUR_CONTROLLER = "gfmhil"
