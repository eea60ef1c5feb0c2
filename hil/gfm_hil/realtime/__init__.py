"""Time and processors: the clock, atomics, priority, and this machine's real-time properties."""
