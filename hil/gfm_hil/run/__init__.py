"""Running a scenario: the run folder, and what the recording shows (metrics, ripple, modes,
checks of a signal, the loop's delay, summary.json)."""
