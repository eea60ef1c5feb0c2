"""Gains that hold in a box of real loops: the box, the constraints, the search, the check."""
