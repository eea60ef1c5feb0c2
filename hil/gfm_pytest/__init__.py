"""The pytest plugin, in a package of its own: pytest imports it in every project where gfmhil is
installed, and importing ``gfm_hil`` would bring numba and set the threads of linear algebra."""
