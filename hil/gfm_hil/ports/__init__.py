"""An operator's ways into a run in progress: commands, streams, the scope, Modbus and XCP.

Each port is a process or thread beside the run: it reads the recording, to which the loops only
append, and passes commands to the command servers of both sides. No loop waits for it.
"""
