"""What ``gfmhil`` re-exports: the objects, and the functions by which a program and the command
line start a run or a study."""
