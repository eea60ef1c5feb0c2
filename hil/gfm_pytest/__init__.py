"""The pytest plugin. It is a separate package because pytest imports it in every project where
gfmhil is installed, and importing ``gfm_hil`` loads numba and sets the threads of linear algebra.
"""
