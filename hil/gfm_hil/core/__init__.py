"""What every room uses: errors, the two roles, temporary folders, being stopped, BLAS settings."""
