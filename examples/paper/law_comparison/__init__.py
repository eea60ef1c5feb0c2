"""Every law tuned for the paper's converter and tried on the bench, one row a law."""
