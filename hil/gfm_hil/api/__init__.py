"""What ``gfmhil`` offers: laws, loops, runs and studies as objects and functions, which the
commands call too."""
