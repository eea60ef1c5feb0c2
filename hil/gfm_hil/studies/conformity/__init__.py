"""Published tests of grid-forming converters as data, each run and judged clause by clause."""
