"""What all packages use: errors, the two roles, temporary folders, signals, BLAS settings."""
