"""A live scope in the browser: a server that reads what a run records, and a page that shows it.

The server is a process of its own. It reads the run's recording, which is only ever appended to,
and passes commands to the desks of both sides; the loop knows nothing of it.
"""
