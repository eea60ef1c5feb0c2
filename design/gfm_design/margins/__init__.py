"""What a loop stands: gain, phase, disk, delay and parameter margins."""
