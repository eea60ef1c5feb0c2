"""A run as it goes: the set-up, the handshake, the tick loops, the timeline, the two processes."""
