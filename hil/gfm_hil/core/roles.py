"""The two roles of a run: the controller and the plant."""

from typing import Literal

Role = Literal["controller", "plant"]
ROLES: tuple[Role, ...] = ("controller", "plant")
OTHER: dict[Role, Role] = {"controller": "plant", "plant": "controller"}

#: what this project's own controller calls itself
OUR_CONTROLLER = "gfmhil"
_ELSEWHERE = f"{OUR_CONTROLLER} on "


def our_controller_on(target: str) -> str:
    """What our controller calls itself when a target runs its laws."""
    return _ELSEWHERE + target


def target_of(controller: str | None) -> str | None:
    """The target that runs the laws of a controller of this name.

    Returns:
        "" if the controller itself runs our laws, None if it is not ours.
    """
    if controller == OUR_CONTROLLER:
        return ""
    if controller is not None and controller.startswith(_ELSEWHERE):
        return controller.removeprefix(_ELSEWHERE)
    return None
