"""Measurements that need foreign packages; what needs none is ``gfmhil bench``."""
