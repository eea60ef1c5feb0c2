"""Margins of a loop: gain, phase, disk, delay and parameters."""
