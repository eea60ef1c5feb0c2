"""A live scope in the browser: a server that reads a run's recording, and a page that shows it.

The server is a separate process. It reads the recording, to which the loop only appends, and passes
commands to the desks of both sides; the loop is unaware of it.
"""
