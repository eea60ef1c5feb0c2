"""The recording of a run: the table of its columns, its writers and its readers.

Only ``Run`` (finished runs) and ``LiveRun`` (runs in progress) read a recording.
"""
