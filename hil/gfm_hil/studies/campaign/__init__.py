"""Campaigns: one scenario run many times with drawn parameters, on all cores or on a cluster."""
