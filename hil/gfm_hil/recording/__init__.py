"""The record of a run: its columns, the recorder that fills them, and the log of events."""
