"""A live scope in the browser: a server that reads a run's recording, and a page that shows it.

The server is a process of its own. It reads the recording, to which the loops only append, and
passes commands to the command servers of both sides. No loop waits for it.
"""
