"""ZeroMQ over ipc or tcp."""

from gfm_hil.links.zeromq.link import ZmqLink

__all__ = ["ZmqLink"]
