"""gfmhil keys: key pairs for a link between two machines."""

import argparse
from pathlib import Path

from gfm_hil.core.roles import ROLES


def add(command: argparse.ArgumentParser) -> None:
    command.description = "Make a key pair per role, for ZeroMQ between two machines (CURVE)."
    command.add_argument("-o", "--out", default="keys", help="folder (%(default)s)")
    command.add_argument("--force", action="store_true", help="replace the keys that are there")


def call(options: argparse.Namespace) -> int:
    from gfm_hil.links.zeromq.curve import write_keys

    folder = Path(options.out)
    write_keys(folder, options.force)
    for role, other in zip(ROLES, ROLES[::-1], strict=True):
        print(f"the {role}'s machine: {folder / role}.key_secret {folder / other}.key")
    print(f"on both: link.options.curve = {str(folder)!r}, or --option curve={folder}")
    return 0
