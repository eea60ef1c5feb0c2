"""Time and processors: the clock, atomics, priority, and what timing on this machine depends on."""
