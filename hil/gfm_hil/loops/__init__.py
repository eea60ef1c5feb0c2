"""The two sides' ticks as compiled loops: no Python and no interpreter's lock while they run."""
