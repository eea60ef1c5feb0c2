"""The recording of a run: the table of its columns, its writers and its readers.

Only ``RecordedRun`` (finished runs) and ``LiveRun`` (runs in progress) read a recording.
"""
