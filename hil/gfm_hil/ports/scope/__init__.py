"""A live scope in the browser: a server that reads a run's recording, and a page that shows it."""
