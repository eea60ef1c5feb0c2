"""The record of a run: the table of its columns, and what writes them.

``RecordedRun`` reads a run that is over, ``LiveRun`` one that is going on; nothing else does.
"""
